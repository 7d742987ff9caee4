"""How files of all kinds are refused."""

import pytest

from protocols.errors import ProtocolError


def refusal(call, *arguments):
    """Return the one line that a call is refused with."""
    with pytest.raises(ProtocolError) as refused:
        call(*arguments)
    message = str(refused.value)
    assert message.isprintable()
    assert len(message) < 400
    assert refused.value.exit_status == 2
    return message
