"""Errors of the model of bench and reed."""

from holography.errors import BenchError


class ImpossibleReedError(BenchError):
    """A reed that cannot be: a shape, a clamp or cane of no reed, or a mode that it does not have.

    Only this says that parameters lie outside physics. Any other error of a computation is a
    defect, and must not be taken for an impossible reed.
    """

    exit_status = 2
