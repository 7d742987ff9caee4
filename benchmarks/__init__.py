"""Benchmarks: every figure that the project claims, beside a peer or a limit."""
