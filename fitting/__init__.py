"""Run files → pictures → named resonances with errors → parameters of the reed's cane.

Nothing here knows an instrument.
"""
