"""The drive of a sweep: what is expected of its magnitude, and its lines."""
