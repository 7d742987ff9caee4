"""Figures: what a run, a fit, a reed and a diagnosis look like."""
