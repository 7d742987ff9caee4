"""Options of drivers: what is wrong is named in one short line."""

import pytest

from drivers.errors import BenchSetupError
from drivers.options import Options, read_options


class Two(Options):
    port: str
    baud: int = 9600


def said(content):
    with pytest.raises(BenchSetupError) as refused:
        read_options(Two, content, "mine", "instruments.synthesizers.options")
    return str(refused.value)


def test_the_key_the_fault_and_the_remedy_are_named():
    assert "instruments.synthesizers.options.prot: unknown key; known are port" in said(
        {"prot": "/dev/ttyUSB0"}
    )
    assert "options.port: is missing; add it" in said({})
    assert "options.baud: " in said({"port": "a", "baud": "fast"})


@pytest.mark.parametrize(
    "content", [{"9" * 10_000: 1}, {"port": 5 * 10**4000}, {"port": ["x"] * 10_000}]
)
def test_a_message_about_something_long_is_short(content):
    assert len(said(content)) < 400
