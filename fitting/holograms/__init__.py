"""Displacement of the reed from its holograms."""
