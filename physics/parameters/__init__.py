"""The parameter tree of a bench with a reed: what `render` plays and `predict` computes from."""
