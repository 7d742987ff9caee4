"""Benchmarks: speed and memory compared with a peer or a limit, and what survives faults."""
