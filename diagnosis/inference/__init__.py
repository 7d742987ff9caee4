"""Fit candidate causes to the observables of a campaign, and weigh them by their evidence."""
