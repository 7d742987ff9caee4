"""What campaigns as these cannot tell: fixed before any sealed case is answered.

By the likeness of what effects move on simulated campaigns (`python -m benchmarks.reach`), whose
causes were known.
"""

from typing import Final

# Effects that count as one.
CLASSES: Final[tuple[tuple[str, ...], ...]] = (("air_load", "stiffening"),)
