"""Work on few holograms (or others) at a time, on two processors."""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from typing import TypeVar

Made = TypeVar("Made")

# Holograms whose arrays still lie in the processor's cache.
_TOGETHER = 24
# More threads wait for the interpreter longer than they compute.
_THREADS = 2


def map_threads(work: Callable[[slice], Made], count: int, together: int = _TOGETHER) -> list[Made]:
    """Do some work for few holograms (or others) at a time, on two processors; results in order.

    Work must not call this again: it would wait for itself.
    """
    parts = [slice(k, k + together) for k in range(0, count, together)]
    if len(parts) < 2:
        return [work(part) for part in parts]
    # numpy lets go of the interpreter while it computes.
    return list(_threads(os.getpid()).map(work, parts))


@lru_cache(maxsize=1)
def _threads(process: int) -> ThreadPoolExecutor:
    """Threads that are kept: to start some for every sum takes as long as the sum.

    A process that was split off from another has none of its threads.
    """
    return ThreadPoolExecutor(_THREADS, thread_name_prefix=f"parts of {process}")
