"""What is known of the clocks of instruments, without asking them."""

from types import SimpleNamespace

import pytest

from drivers.generators.keysight import KeysightGenerator
from drivers.generators.siglent import SiglentGenerator
from drivers.generators.soundcard import SoundCardGenerator
from drivers.reference_clock import reference_clock
from drivers.synthesizers.novatech import Novatech409B
from drivers.synthesizers.srs import SRSPair


@pytest.mark.parametrize(
    ("driver", "options", "source"),
    [
        (SiglentGenerator, {}, "external"),
        (SiglentGenerator, {"reference": "internal"}, "own"),
        (KeysightGenerator, {"reference": "external"}, "external"),
        (Novatech409B, {}, "own"),
        (Novatech409B, {"external_reference": True}, "external"),
        (SRSPair, {}, "external"),
        (SRSPair, {"check_timebase": False}, "unknown"),
        (SoundCardGenerator, {}, "own"),
    ],
)
def test_the_clock_follows_from_what_a_driver_checked(driver, options, source):
    # It was opened, and is not asked again.
    instrument = driver.__new__(driver)
    clock = reference_clock(SimpleNamespace(options=options), instrument)
    assert clock.source == source
    assert clock.words


@pytest.mark.parametrize(
    ("said", "source"), [("external", "external"), ("own", "own"), ("rubidium", "unknown")]
)
def test_a_driver_of_others_may_say_it_itself(said, source):
    theirs = SimpleNamespace(identity="theirs", reference_clock=lambda: said)
    assert reference_clock(SimpleNamespace(options={}), theirs).source == source


def test_a_driver_that_does_not_say_it_is_not_known():
    clock = reference_clock(SimpleNamespace(options={}), SimpleNamespace(identity="theirs"))
    assert (clock.source, "not known" in clock.words) == ("unknown", True)
