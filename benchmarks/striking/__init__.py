"""Faults that strike a run, and processes that they strike."""
