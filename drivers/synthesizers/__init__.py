"""Drivers of frequency synthesizers for the two AOMs."""
