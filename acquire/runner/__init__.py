"""The runner: measures one sweep, and leaves the bench off however the sweep ends."""
