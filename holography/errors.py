"""Base class of all errors that this software raises on purpose."""


class BenchError(Exception):
    """An error that the operator can understand and correct.

    The message is one line, in the form ``thing: state; remedy``. The command line prints it
    without a traceback.

    Attributes
    ----------
    exit_status : int
        Exit status of the command line: 2 for bad input, 1 for a failed run.
    unconfirmed : tuple of str
        Outputs of the bench that are not confirmed off.
    """

    exit_status: int = 1
    unconfirmed: tuple[str, ...] = ()


class MissingLibraryError(BenchError):
    """An optional library that is not installed; names the command that installs it."""

    exit_status = 2
