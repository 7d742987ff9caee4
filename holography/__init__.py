"""Digital holography: frames → complex hologram → field on the object → displacement.

All functions are pure functions of arrays. Instruments, reeds and files are not known here.
"""
