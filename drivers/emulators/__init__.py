"""Emulated instruments that speak the real wire protocols."""
