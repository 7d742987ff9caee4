"""Protocols and bench files that come with the software, as package data."""
