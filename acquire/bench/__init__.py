"""Checks of a bench: open, identify, limits, one locked shot, off."""
