"""Closure of every effect: what the simulated bench renders against what `predict` says."""
