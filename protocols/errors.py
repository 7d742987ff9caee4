"""Errors of protocol, bench, reed and campaign files."""

from holography.errors import BenchError


class ProtocolError(BenchError):
    """A protocol or bench file that cannot be used; names the file and the key path."""

    exit_status = 2
