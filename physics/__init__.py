"""Model of the bench from first principles: reed, air, drive, optics and sensor.

Instruments, files and protocols are not known here.
"""
