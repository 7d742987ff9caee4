"""Threads of linear algebra, counted where a function is called."""

from contextlib import contextmanager

import pytest
from threadpoolctl import threadpool_info, threadpool_limits


class ReachedError(Exception):
    """Where threads were counted; its argument is their number."""


def count_threads(*_args, **_kwargs):
    raise ReachedError(count_of_threads())


def count_of_threads():
    return max(p["num_threads"] for p in threadpool_info() if p["user_api"] == "blas")


@contextmanager
def two_threads():
    """Have two threads, whatever the machine and its environment say."""
    with threadpool_limits(limits=2, user_api="blas"):
        if count_of_threads() < 2:
            pytest.skip("linear algebra has but one thread on this machine")
        yield
