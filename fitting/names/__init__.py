"""Names of fitted modes, with their probabilities."""
