"""Why an instrument on a network cannot be reached: an unknown name, or a refused connection."""

import socket
from typing import Final

from drivers.errors import InstrumentError

# What the name service answers for a name that does not exist (RFC 3493, section 6.1). Every other
# number means that it gave no answer. EAI_NODATA is not defined on all systems.
_UNKNOWN: Final = {socket.EAI_NONAME, getattr(socket, "EAI_NODATA", socket.EAI_NONAME)}


def require_known_host(host: str, place: str, option: str) -> None:
    """Require that a host name can be resolved; an IP address always can.

    Parameters
    ----------
    host : str
    place : str
        Role, model and address of the instrument, for the message.
    option : str
        Option of the bench file that holds the name, for the message.

    Raises
    ------
    InstrumentError
        If there is no host of this name, or the name service does not answer.
    """
    try:
        socket.getaddrinfo(host, None)
    except socket.gaierror as error:
        if error.errno in _UNKNOWN:
            raise _unknown(host, place, option) from error
        raise InstrumentError(
            f"{place}: the name service does not answer for the host {host!r} ({error.strerror}); "
            f"check this computer's network, or write the IP address in {option}"
        ) from error
    except UnicodeError as error:
        # A label that is empty or too long for a host name.
        raise _unknown(host, place, option) from error


def _unknown(host: str, place: str, option: str) -> InstrumentError:
    return InstrumentError(
        f"{place}: there is no host of the name {host!r}; correct the host name in {option}, or "
        "write the IP address"
    )


def is_refused(error: BaseException) -> bool:
    """Return whether an error goes back to a host that refused the connection."""
    cause: BaseException | None = error
    while cause is not None:
        if isinstance(cause, ConnectionRefusedError):
            return True
        cause = cause.__cause__ or cause.__context__
    return False
