"""Resonances without a run, of reeds whose frequencies follow from their moduli by a formula."""

import io
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
from rich.console import Console

from diagnosis.effect_notes import notes_of
from diagnosis.mean_reed import (
    MeanReed,
    printed_reeds,
    tabled_reeds,
)
from diagnosis.resonance_diagnosis import diagnose_resonances
from diagnosis.resonance_fit import _explained
from fitting.errors import FitInputError
from fitting.forward import cents_of
from physics.effects.effect import (
    Effect,
    Parameter,
    Stage,
)
from physics.errors import ImpossibleReedError
from physics.parameters.tree import with_cane
from physics.reed.cane.viscoelastic import Series
from physics.reed.mode_classification import PAPER_MODES
from reports.resonance_diagnosis import trials_table, words
from reports.tables import terminal_table

MODES = PAPER_MODES[:8]
HZ = np.array([2000, 3400, 5100, 6800, 8300, 9900, 11500, 12900.0])
# Shares of each mode's energy: bending, the rest is shear; what E_T and G_LR have of it besides.
BENDING = np.array([0.95, 0.3, 0.85, 0.35, 0.5, 0.8, 0.4, 0.45])
ACROSS = np.array([0.0, 0.02, 0.05, 0.1, 0.45, 0.1, 0.2, 0.4])
CENTS = 600 / np.log(2)


class Formula:
    """A reed_solver in which no mode mixes with another."""

    def __init__(self):
        cane = SimpleNamespace(E_L_pa=14e9, G_LT_pa=1.1e9)
        self.reed = SimpleNamespace(cane=cane)

    def modes(self, reed):
        shift = reed.shift
        log = BENDING * shift.E_L + (1 - BENDING) * shift.G_LT + ACROSS * shift.E_T
        hz = HZ * np.exp(0.5 * (log - shift.density + 0.5 * ACROSS**2 * shift.G_LR))
        return {name: SimpleNamespace(hz=f) for name, f in zip(MODES, hz.tolist(), strict=True)}


def effect(name, *moduli, spread=0.3):
    """An effect that shifts moduli."""

    def change(parameters, values):
        return with_cane(parameters, **dict.fromkeys(moduli, values["size"]))

    return Effect(
        id=name, title=name, stage=Stage.MECHANICS,
        parameters=(Parameter("size", "", spread, "toy"),), change=change,
        reference="",
    )  # fmt: skip


ACROSS_GRAIN, TWIN_OF_IT = effect("across", "E_T"), effect("similar", "E_T", spread=0.2)
HEAVIER, NOTHING = effect("heavier", "density"), effect("nothing")
SHEAR = effect("shear", "G_LR")


def reeds(across=0.0, noise_cents=2.0, seed=0):
    """Mean reeds of both series, whose moduli differ."""
    rng = np.random.default_rng(seed)
    found = []
    for series, E, G in ((Series.A, 0.1, -0.2), (Series.B, -0.05, 0.1)):
        cents = cents_of(HZ) + CENTS * (BENDING * E + (1 - BENDING) * G + ACROSS * across)
        cents = cents + noise_cents * rng.standard_normal(len(HZ))
        found.append(MeanReed(series, MODES, cents, np.full(len(HZ), 2.0), 50))
    return found


diagnosed = partial(diagnose_resonances, reed_solver=Formula(), largest_set=2)


def test_what_closes_the_gap_is_found_with_its_size() -> None:
    found = diagnosed(reeds(across=0.4), effects=(SHEAR, ACROSS_GRAIN, HEAVIER, NOTHING))
    best = found.single[0]
    assert best.effects == ("across",)
    assert best.converged
    (size,) = best.sizes
    assert size.value == pytest.approx(0.4, abs=3 * size.error)
    assert size.error < 0.05
    assert best.explained_low > 0.9
    assert set(best.explained_other_series) == {"A", "B"}
    assert min(best.explained_other_series.values()) > 0.9
    assert best.rms_cents["A"] < 3 < 20 < found.elastic.rms_cents["A"]
    for series, E, G in (("A", 0.1, -0.2), ("B", -0.05, 0.1)):
        E_L, G_LT = best.moduli_pa[series]
        assert np.log([E_L / 14e9, G_LT / 1.1e9]) == pytest.approx([E, G], abs=0.02)
    # A density that moduli take up closes nothing.
    heavier = next(trial for trial in found.single if trial.effects == ("heavier",))
    assert heavier.log_bayes < 0
    assert abs(heavier.explained) < 0.05
    assert all(trial.effects != ("nothing",) for trial in found.single)
    assert all("across" in trial.effects for trial in found.together[:2])


def test_where_the_elastic_reed_is_right_nothing_is_likelier() -> None:
    for seed in range(3):
        found = diagnosed(reeds(seed=seed), effects=(SHEAR, ACROSS_GRAIN, HEAVIER))
        assert max(trial.log_bayes for trial in found.single) < 1.5
        assert found.elastic.rms_cents["A"] < 4


def test_effects_that_do_the_same_are_one_class() -> None:
    found = diagnosed(reeds(across=0.4), effects=(ACROSS_GRAIN, TWIN_OF_IT, HEAVIER))
    assert ("across", "similar") in [tuple(sorted(group)) for group in found.classes]
    by_name = {entry.effect: entry for entry in found.detectability}
    assert by_name["heavier"].absorbed > 0.99
    assert by_name["across"].absorbed < 0.9


def test_words_say_whose_sizes_are_and_what_is_hardly_distinguished() -> None:
    effects = (ACROSS_GRAIN, TWIN_OF_IT, HEAVIER, SHEAR)
    found = diagnosed(reeds(across=0.4), effects=effects)
    said = words(found, {effect.id: effect for effect in effects})
    trial = next(trial for trial in found.single if trial.effects == ("across",))
    (size,) = trial.sizes
    assert f"across: size {size.value:.3g} ± {size.error:.1g} ({size.z:+.1f} SD" in "\n".join(said)
    hardly = next(line for line in said if line.startswith("across is confusable"))
    # Both move the same.
    assert "similar (1.00)" in hardly
    assert hardly.endswith(notes_of(ACROSS_GRAIN).check)
    both = next(trial for trial in found.together if trial.converged and trial.log_bayes > 1)
    line = next(line for line in said if line.startswith(" + ".join(both.effects)))
    assert all(f"{name}'s size" in line for name in both.effects)
    assert "does not prove its cause" in said[-1]


def test_the_table_of_trials_gives_fractions_as_they_are() -> None:
    found = diagnosed(reeds(across=0.4), effects=(ACROSS_GRAIN, HEAVIER))
    console = Console(width=200, file=io.StringIO())
    console.print(terminal_table(trials_table(found)))
    row = next(r for r in console.file.getvalue().splitlines() if "across " in r)
    best, before = found.single[0], found.elastic.rms_cents
    assert f"{best.explained:.0%}" in row
    assert f"{before['A']:.0f} → {best.rms_cents['A']:.0f}" in row
    assert f"A {best.explained_other_series['A']:.0%}" in row
    assert f"{best.log_bayes:+.1f}" in row


def test_rows_of_other_modes_are_reported(tmp_path) -> None:
    said = []
    odd = ["1,A,f2,3400.0", "1,A,X7,9900.0"]
    (reed,) = tabled_reeds(table(tmp_path, *rows("1", -30), *odd, *rows("2", 10)), said.append)
    assert reed.modes == MODES
    assert len(said) == 1
    assert said[0].endswith(": 2, not used")
    said.clear()
    tabled_reeds(table(tmp_path, *rows("1", -30), *rows("2", 10)), said.append)
    assert not said


def test_a_mode_that_no_such_reed_has_is_named() -> None:
    alien = [MeanReed(Series.A, ("X9",), np.zeros(1), np.ones(1), 1)]
    with pytest.raises(ImpossibleReedError, match="no mode X9"):
        diagnosed(alien, effects=(HEAVIER,))


@pytest.mark.parametrize(
    ("series", "name", "mean_hz", "sd_hz"), [("A", "F1", 1996, 77), ("B", "T1", 3436, 129)]
)
def test_printed_means_are_those_of_logarithms(series, name, mean_hz, sd_hz) -> None:
    reed = next(reed for reed in printed_reeds() if reed.series == series)
    cents = dict(zip(reed.modes, reed.cents, strict=True))[name]
    # Of a lognormal scatter the mean logarithm is lower.
    hz = mean_hz / np.sqrt(1 + (sd_hz / mean_hz) ** 2)
    assert cents == pytest.approx(float(cents_of(hz)), abs=0.01)


def rows(reed, shift_cents, modes=MODES, series="A"):
    scale = 2 ** (shift_cents / 1200)
    return [
        f"{reed},{series},{name},{hz * scale:.9f}"
        for name, hz in zip(MODES, HZ.tolist(), strict=True)
        if name in modes
    ]


def table(folder, *lines):
    path = folder / "reeds.csv"
    path.write_text("\n".join(["reed,series,mode,hz", *lines]) + "\n", "utf-8")
    return path


def test_means_of_a_table_are_those_of_its_reeds(tmp_path) -> None:
    path = table(tmp_path, *rows("1", -30), *rows("2", 10), *rows("3", 50))
    (reed,) = tabled_reeds(path)
    assert reed.series is Series.A
    assert reed.modes == MODES
    assert reed.reeds == 3
    assert reed.cents == pytest.approx(cents_of(HZ) + 10, abs=1e-3)


def test_means_of_many_reeds_are_as_sure_as_their_number(tmp_path) -> None:
    path = table(tmp_path, *[row for k in range(16) for row in rows(k, 5 * k)])
    (reed,) = tabled_reeds(path)
    # Reading to 25 cents / √12 and a scatter of 25 cents, of sixteen reeds.
    assert reed.error_cents == pytest.approx(np.hypot(25 / np.sqrt(12), 25) / 4, rel=1e-6)


def test_shares_that_are_closed_are_of_what_is_above_the_floor() -> None:
    before, after = np.array([2.0, -1.0, 3.0]), np.array([1.0, 1.0, -1.5])
    explained, low, high = _explained(before, after, ("F1", "T1", "F2"))
    gaps = [np.mean(part**2) - 1 for part in (before, after)]
    assert explained == pytest.approx((gaps[0] - gaps[1]) / gaps[0])
    assert low <= explained <= high


def test_a_reed_that_lacks_modes_does_not_bend_the_profile(tmp_path) -> None:
    # The highest reed lacks two modes: a plain mean of these would be lower than of the others.
    path = table(tmp_path, *rows("1", -30), *rows("2", 10), *rows("3", 50, MODES[:6]))
    (reed,) = tabled_reeds(path)
    assert reed.cents == pytest.approx(cents_of(HZ) + 10, abs=1e-3)


def test_a_reed_that_shows_only_what_hardly_any_shows_does_not_count(tmp_path) -> None:
    rare = f"5,A,{PAPER_MODES[9]},15000"
    path = table(tmp_path, *[row for k in "1234" for row in rows(k, 0)], rare)
    (reed,) = tabled_reeds(path)
    assert reed.reeds == 4
    assert reed.cents == pytest.approx(cents_of(HZ), abs=1e-3)
    assert np.isfinite(reed.error_cents).all()


def test_tables_that_tell_too_little_are_refused(tmp_path) -> None:
    with pytest.raises(FitInputError, match="no series has four of the modes"):
        tabled_reeds(table(tmp_path, *rows("1", 0, MODES[:3])))
    with pytest.raises(FitInputError, match="has no rows"):
        tabled_reeds(table(tmp_path))
