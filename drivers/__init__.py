"""Instruments: one interface per role, and drivers that fill the roles."""
