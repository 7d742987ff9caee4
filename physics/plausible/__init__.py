"""Reeds that are plausible before anything is measured."""
