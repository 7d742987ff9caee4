"""Measurement against model: where the gap lies, which effect explains it, how far it shrinks.

Nothing here knows an instrument.
"""
