"""Sealed cases: what was published of them, and their answers."""
