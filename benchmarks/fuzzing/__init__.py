"""Mutants of all kinds of files, and how they are judged."""
