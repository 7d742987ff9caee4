"""Effects of the second laboratory: one class for each thing that may be wrong."""
