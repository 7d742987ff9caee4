"""Acoustic resonances of the bench: poles of the drive of one sweep, and of several reeds."""
