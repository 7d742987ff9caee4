"""Checks and checksums of run files."""
