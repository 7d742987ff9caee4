"""Numbers that tests of several packages need."""

import numpy as np


def complex_normal(rng, *shape):
    """Complex Gaussian noise of variance 1."""
    return (rng.standard_normal(shape) + 1j * rng.standard_normal(shape)) / np.sqrt(2)


def cents(one_hz, other_hz):
    """Return the interval from one frequency to another, in cents."""
    return 1200 * np.log2(np.asarray(one_hz) / np.asarray(other_hz))


def relative_error(computed, expected):
    """Return the norm of a deviation, relative to that of what is expected."""
    return np.linalg.norm(computed - expected) / np.linalg.norm(expected)
