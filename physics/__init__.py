"""The twin: reed, air, drive, optics and sensor of the bench, from first principles.

Nothing here knows an instrument, a file or a protocol.
"""
