"""The runner: one sweep from the first step to the last, and all ways out of it."""
