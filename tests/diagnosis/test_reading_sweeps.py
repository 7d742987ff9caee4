"""In which order sweeps are fitted, from what, and what becomes of those that cannot be."""

import multiprocessing
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.special import j1

from diagnosis.readings import sweeps as sweep_readings
from diagnosis.readings import templates as template_readings
from diagnosis.readings.sweeps import _doubtful, _log_light
from diagnosis.readings.templates import TEMPLATES, templates
from fitting.errors import FitError

VOLTS = {"up": 8.0, "down": 8.0, "quiet": 2.0, "again": 8.0}


class CampaignRun(SimpleNamespace):
    """A part of a campaign."""

    __hash__ = object.__hash__


def part(name: str) -> CampaignRun:
    steps = [SimpleNamespace(volts=VOLTS[name])] * 3
    path = Path(f"{name}.h5")
    run = SimpleNamespace(name=name, path=path, series="A", steps=steps, reed_file=lambda: None)
    return CampaignRun(name=name, clamping=int(name == "again"), run=run)


PARTS = [part(name) for name in VOLTS]


@pytest.fixture
def fitted(monkeypatch):
    """Fits that say their origin; a test sets doubts and the sweeps that cannot be fitted."""
    faked = SimpleNamespace(doubt={}, refused=set(), lost=set(), again=[])

    def jointly(run, _reed, _model, _light):
        if run.name in faked.refused:
            raise FitError(f"{run.name} cannot be fitted")
        return SimpleNamespace(name=run.name, resonances={"F1": 1}, of=run.name)

    def again(run, before, _reed, unshifted):
        faked.again.append((before.name, run.name))
        if run.name in faked.lost:
            raise FitError(f"{run.name} shows another reed")
        return SimpleNamespace(name=run.name, resonances=before.resonances, of=before.of)

    monkeypatch.setattr(sweep_readings, "basis_of", lambda _file: None)
    monkeypatch.setattr(sweep_readings, "finite_element_model", lambda _reed: None)
    monkeypatch.setattr(sweep_readings, "fit_jointly", jointly)
    monkeypatch.setattr(sweep_readings, "fit_same_reed", again)
    monkeypatch.setattr(sweep_readings, "fit_without_unshifted", lambda fit, *_: fit)
    monkeypatch.setattr(sweep_readings, "_doubt", lambda fit: faked.doubt.get(fit.name, (0, 0.0)))
    monkeypatch.setattr(sweep_readings, "_reading", lambda part, fit, _off: (part.name, fit.of))
    yield faked
    assert not multiprocessing.active_children()


def test_all_others_are_fitted_from_the_loudest(fitted, monkeypatch) -> None:
    # In this process, which sees what is called.
    monkeypatch.setattr(
        sweep_readings, "map_processes", lambda work, items: (work(item) for item in items)
    )
    read, refused = sweep_readings.read_sweeps(PARTS)
    assert read == [(name, "up") for name in VOLTS]
    assert not refused
    assert fitted.again == [("up", "down"), ("up", "quiet"), ("up", "again")]


def test_one_in_doubt_is_handed_on_from_the_calmest_to_the_loudest(fitted) -> None:
    fitted.doubt = dict.fromkeys(VOLTS, (1, 1.0)) | {"up": (1, 0.0)}
    read, refused = sweep_readings.read_sweeps(PARTS)
    assert read == [(name, "up") for name in VOLTS]
    assert not refused
    assert fitted.again == [
        ("up", "quiet"),
        ("quiet", "up"),
        ("up", "down"),
        ("down", "again"),
        ("again", "up"),
    ]


def test_the_first_without_doubt_will_do(fitted) -> None:
    # Of those that are tried after the loudest: the calmest, then one of another clamping.
    fitted.doubt = {"up": (1, 2.0), "quiet": (1, 1.0)}
    assert {of for _, of in sweep_readings.read_sweeps(PARTS)[0]} == {"again"}


def test_the_least_doubtful_will_do_if_none_is_without(fitted) -> None:
    fitted.doubt = {"up": (1, 2.0), "quiet": (1, 1.0), "again": (2, 0.0), "down": (1, 3.0)}
    assert {of for _, of in sweep_readings.read_sweeps(PARTS)[0]} == {"quiet"}


def test_what_cannot_be_fitted_by_itself_can_from_another(fitted) -> None:
    fitted.refused = {"up", "quiet"}
    read, refused = sweep_readings.read_sweeps(PARTS)
    assert read == [(name, "again") for name in VOLTS]
    assert not refused


def test_what_cannot_be_fitted_at_all_is_reported_with_its_reason(fitted) -> None:
    fitted.lost = {"down"}
    read, refused = sweep_readings.read_sweeps(PARTS)
    assert [name for name, _ in read] == ["up", "quiet", "again"]
    assert refused == ["down shows another reed"]


def test_a_campaign_of_which_nothing_can_be_fitted_is_reported(fitted) -> None:
    fitted.refused = set(VOLTS)
    read, refused = sweep_readings.read_sweeps(PARTS)
    assert not read
    assert refused == [f"{name} cannot be fitted" for name in VOLTS]


def test_contrast_that_the_object_field_takes_up_is_not_missed(monkeypatch) -> None:
    """A fit leaves of lost contrast what differs from the mean of each block's holograms."""
    rng = np.random.default_rng(5)
    holograms, blocks, loss = 60, 80, 1e-3
    functions = rng.standard_normal((blocks, 2))
    amplitude = 4 * rng.uniform(0.2, 1, (holograms, 1)) * (1 + 0.3j * rng.standard_normal(2))
    field = np.exp(2j * np.pi * rng.random(blocks)) * rng.uniform(0.5, 2, blocks)
    u = amplitude @ functions.T
    fringes = u / np.abs(u) * j1(np.abs(u)) * field
    lost = -loss * np.abs(u) ** 2 * fringes
    taken_up = np.sum(fringes.conj() * lost, axis=0) / np.sum(np.abs(fringes) ** 2, axis=0)
    left = lost - taken_up * fringes
    fitted = SimpleNamespace(
        displacements=SimpleNamespace(
            amplitude_rad=amplitude, gain=np.zeros(holograms),
            object_field=np.broadcast_to(field, u.shape), misfit=np.ones(holograms),
            reached=np.ones(holograms, dtype=bool),
        ),
        basis=SimpleNamespace(functions=functions),
        block_amplitudes=SimpleNamespace(recorded=(fringes + left).T, independent_fraction=1.0),
    )  # fmt: skip
    monkeypatch.setattr(template_readings, "explained_amplitudes", lambda *_: fringes)
    template, variance = templates(fitted)
    weight = 1 / variance[TEMPLATES.index("decorrelation")]
    found = np.sum(weight * template[TEMPLATES.index("decorrelation")].real) / np.sum(weight)
    # What displacements and gains take up is not of the same size in every hologram.
    assert found == pytest.approx(loss, rel=0.05)
    # Blocks that share noise know less.
    fitted.block_amplitudes.independent_fraction = 0.5
    assert templates(fitted)[1] == pytest.approx(2 * variance)


@pytest.mark.parametrize("still", [True, False])
def test_light_is_that_of_all_pixels_whatever_noise_blocks_have(still):
    rng = np.random.default_rng(2)
    noise, light = rng.uniform(0.7, 2.5, 40), rng.uniform(5, 50, (6, 40))
    moved = np.ones((6, 40)) if still else np.abs(rng.standard_normal((6, 40)))

    def fit(block_noise):
        return SimpleNamespace(
            displacements=SimpleNamespace(
                object_field=light / np.sqrt(block_noise), gain=np.zeros(6)
            ),
            block_amplitudes=SimpleNamespace(noise_variance=block_noise),
        )

    level = np.full(6, 4.0)
    expected = 0.5 * np.log(4.0 * np.mean((light * moved) ** 2, axis=1))
    assert _log_light(fit(np.ones(40)), level, moved) == pytest.approx(expected)
    assert _log_light(fit(noise), level, moved) == pytest.approx(expected)


def test_modes_that_are_not_identified_are_doubtful() -> None:
    fitted = SimpleNamespace(names=("F1", "T1", "X4"), resonances={"F1": None, "X4": None})
    assert _doubtful(fitted).tolist() == [False, True, False]
    nothing = SimpleNamespace(names=(), resonances={})
    assert _doubtful(nothing).tolist() == []
