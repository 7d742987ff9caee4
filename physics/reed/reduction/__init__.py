"""Reduced-order models of one reed, and what they predict."""
