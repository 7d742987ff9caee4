"""Populations of reeds."""
