"""Amplitudes of vibration in nm, with standard errors: of the whole reed and of each mode."""
