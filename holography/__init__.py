"""Light on a sensor: frames → complex hologram → field on the object → displacement.

Pure functions of arrays. Nothing here knows an instrument, a reed or a file.
"""
