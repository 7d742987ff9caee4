"""Numerical experiments: how far what the project computes lies from the truth."""
