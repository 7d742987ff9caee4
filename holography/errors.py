"""The root of every error that this software raises on purpose."""


class BenchError(Exception):
    """Something that a person at the bench can understand and mend.

    The message is one line and names the thing, the state, what was asked and the remedy. The
    command line prints it without a traceback.

    Attributes
    ----------
    exit_status : int
        Exit status of the command line: 2 for bad input, 1 for a failed run.
    unconfirmed : tuple of str
        Outputs of the bench that are not confirmed to be off.
    """

    exit_status: int = 1
    unconfirmed: tuple[str, ...] = ()
