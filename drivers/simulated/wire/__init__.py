"""Simulated instruments that speak the wire protocols of real ones, for the real drivers."""
