"""What fits read of the bench file in a run."""

from pathlib import Path
from types import SimpleNamespace

import pytest

from fitting.errors import FitInputError
from fitting.known_bench import known_effects_in

SHIPPED = Path(__file__).parents[2] / "protocols" / "benches" / "simulated.yaml"
TEXT = SHIPPED.read_text(encoding="utf-8")


def run(text: str) -> SimpleNamespace:
    return SimpleNamespace(path=Path("a.h5"), bench_text=text)


def test_known_effects_are_those_of_the_bench_file() -> None:
    text = TEXT + "\nknown: {tip_mass: {mass: 2e-6 ± 5e-7 kg}}\n"
    (found,) = known_effects_in([run(text), run(text)])
    assert found.effect.id == "tip_mass"
    assert found.values["mass"] == pytest.approx(2e-6)
    assert found.errors["mass"] == pytest.approx(5e-7)


@pytest.mark.parametrize("text", ["", "name: bench\n"])
def test_a_bench_file_that_cannot_be_read_says_nothing(text: str) -> None:
    assert known_effects_in([run(text)]) == ()


def test_runs_that_do_not_agree_are_refused() -> None:
    known = TEXT + "\nknown: {tip_mass: {mass: 2e-6 kg}}\n"
    with pytest.raises(FitInputError, match="one by one"):
        known_effects_in([run(TEXT), run(known)])


def test_an_effect_that_is_none_is_refused() -> None:
    with pytest.raises(FitInputError, match=r"known\.moon"):
        known_effects_in([run(TEXT + "\nknown: {moon: {phase: 1}}\n")])
