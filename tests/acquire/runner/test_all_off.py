"""Findings of `acquire bench check` and `acquire bench off`: all is switched off at once."""

import threading
from types import SimpleNamespace

from acquire.bench.findings import all_confirmed_off
from drivers.errors import InstrumentError


def test_an_instrument_that_hangs_delays_no_other():
    stopped = threading.Event()

    def rf_off():
        if not stopped.wait(20):
            raise InstrumentError("the camera was not stopped meanwhile")

    instruments = {
        "synthesizers": SimpleNamespace(rf_off=rf_off),
        "camera": SimpleNamespace(stop=stopped.set),
    }
    found = all_confirmed_off("off", instruments)
    assert {role: finding.result for role, finding in found.items()} == {
        "synthesizers": "pass",
        "camera": "pass",
    }
