"""Drivers of signal generators for the loudspeaker."""
