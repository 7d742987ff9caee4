"""Work on few holograms (or others) at a time, on all processors."""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

Made = TypeVar("Made")

# Holograms whose arrays still lie in the processor's cache.
_TOGETHER = 12
_MOST_THREADS = 4


def in_parts(work: Callable[[slice], Made], count: int, together: int = _TOGETHER) -> list[Made]:
    """Do some work for few holograms (or others) at a time, on all processors; results in order."""
    parts = [slice(k, k + together) for k in range(0, count, together)]
    if len(parts) < 2:
        return [work(part) for part in parts]
    # numpy lets go of the interpreter while it computes.
    with ThreadPoolExecutor(min(_MOST_THREADS, os.cpu_count() or 1)) as workers:
        return list(workers.map(work, parts))
