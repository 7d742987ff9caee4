"""Finite elements of a reed: meshes, matrices, solvers."""
