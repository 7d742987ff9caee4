"""Displacements in nm that the fit states, compared with those that frames are rendered from."""
