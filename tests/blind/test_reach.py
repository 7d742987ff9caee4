"""The table of what campaigns can tell is of medians over them."""

import pytest

pytest.importorskip("skfem", reason="the extra 'blind' is not installed")

from diagnosis.inference.similarity import Detectability
from studies.reach import as_drawn, row_of, together


def reach(size, absorbed=0.5, **confusable):
    return Detectability("carrier_leak", absorbed, {"fraction": size}, confusable)


def test_effects_are_confusable_if_they_are_in_more_campaigns_than_not() -> None:
    half = [[reach(0.002, sideband_crosstalk=0.85)], [reach(0.004)]]
    assert together(half)[0].confusable == {}
    most = [*half, [reach(0.003, absorbed=0.1, sideband_crosstalk=0.95)]]
    (found,) = together(most)
    assert found.confusable == {"sideband_crosstalk": 0.85}
    assert found.detectable == {"fraction": 0.003}
    assert found.absorbed == 0.5


def test_a_least_size_is_a_multiple_of_what_blind_cases_draw() -> None:
    # Usual is 1 %.
    assert as_drawn(reach(0.004)) == pytest.approx(0.4)
    line = row_of(reach(0.004, sideband_crosstalk=0.85))
    assert line.split() == [
        "carrier_leak",
        "fraction",
        "0.004",
        "0.40",
        "50%",
        "sideband_crosstalk",
        "0.85",
    ]
