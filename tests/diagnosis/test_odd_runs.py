"""Runs as no good campaign has them: what is not there is left out."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from diagnosis import campaign_diagnosis
from diagnosis.campaign_diagnosis import inference_problem
from diagnosis.observable_groups import Coordinates, Observable, observable_group
from diagnosis.observables.brightness import brightness_group
from diagnosis.observables.carrier import Leaks
from diagnosis.observables.drive import (
    excitation_group,
    force_group,
    level_group,
)
from diagnosis.observables.frequency_lock import lock_group, lock_scatter_hz
from diagnosis.observables.light import fringe_group, mixing_in, noise_group
from diagnosis.observables.modes import modes_group
from diagnosis.observables.reed_at_rest import phase_turn_group, usual_scatter_hz
from diagnosis.readings.camera import read_dark, read_flat
from diagnosis.readings.campaign_readings import _missing, _unread
from diagnosis.readings.carrier import read_carriers
from diagnosis.readings.mean_drive import mean_drive
from diagnosis.readings.reed_at_rest import read_rest_holograms
from diagnosis.readings.step_log import read_step_log
from diagnosis.readings.sweeps import common_modes, names_in_order
from diagnosis.readings.templates import TEMPLATES
from fitting.errors import FitError, FitInputError
from fitting.holograms.block_amplitudes import _holograms
from physics.parameters.optics import Interference
from physics.parameters.tree import BenchParameters
from physics.reed.geometry import ReedGeometry
from protocols.bench import BenchFile
from runs.layout import RunKind
from runs.verdict import Verdict

NO_LEAKS = Leaks({}, 0.0)
MODES = {"F1": 1800.0, "T1": 2900.0, "F2": 5200.0, "T2": 7100.0}
STEPS_HZ = 1000.0 * 2 ** (np.arange(184) / 48)


class FewModes:
    """A reed_solver whose reeds have four modes, whatever their cane is."""

    def modes(self, _reed):
        return {
            name: SimpleNamespace(hz=hz, loss_factor=0.02, stiffening=0.2)
            for name, hz in MODES.items()
        }


def sweep(name="up", drive_hz=STEPS_HZ, volts=8.0, names=tuple(MODES), **changed):
    """Say what a fit says of a sweep in which nothing is off."""
    count, a = len(drive_hz), len(names)
    fields = {
        "name": name,
        "clamping": 0,
        "loudness": float(np.log(volts)),
        "names": names,
        "hz": np.array([MODES.get(mode, 9000.0) for mode in names]),
        "loss_factor": np.full(a, 0.02),
        "stiffening": np.full(a, 0.2),
        "covariance": 1e-8 * np.eye(2 * a),
        "force_rad": np.ones(a, complex),
        "force_error": np.full(a, 0.01),
        "drive_hz": drive_hz,
        "volts": np.full(count, volts),
        "time_s": 1.0 + np.arange(count),
        "log_drive": 0.3 * np.log(drive_hz / 1e3),
        "log_drive_covariance": np.zeros((count, count)),
        "doubtful": np.zeros((0, 2)),
        "amplitude_rad": np.full(count, 2.0),
        "deepest_rad": np.full(count, 3.0),
        "signal": np.log(volts * drive_hz) + 1e-3 * np.sin(np.arange(count)),
        "noise_dn2": 1e3 * np.exp(1e-3 * np.sin(np.arange(count))),
        "fringe_dn2": np.ones(count),
        "off": np.zeros(count, bool),
        "template": np.full((len(TEMPLATES), count), 1e-2 + 0j),
        "template_variance": np.full((len(TEMPLATES), count), 1e-6),
        "taken_off": 0.0,
    }
    return SimpleNamespace(**fields | changed)


def test_numbers_that_are_none_are_refused_by_name() -> None:
    places = [
        Coordinates("force", mode="F1", time="up"),
        Coordinates("force", mode="T1", time="down"),
    ]
    for values, errors in (([1.0, np.nan], [1.0, 1.0]), ([1.0, 1.0], [1.0, 0.0])):
        with pytest.raises(FitInputError, match=r"forces: force T1 .*has no finite value"):
            observable_group(
                "forces",
                Observable.RESPONSE,
                values,
                np.array(errors),
                places,
                (),
                lambda _twin: np.zeros(2),
            )


def test_sweeps_without_a_measured_lock_have_no_lock() -> None:
    step = SimpleNamespace(
        verdict=Verdict.OK, order=1, lock_error_hz=np.nan, lock_error_se_hz=np.nan,
        read_drive_hz=None, drive_hz=2000, timestamps_s=(5.0,),
    )  # fmt: skip
    run = SimpleNamespace(steps=[step] * 20, earlier_attempts=(), sideband_order=1)
    beat = read_step_log([SimpleNamespace(run=run, name="up", clock_s=0.0)])
    assert beat.steps == 20
    assert lock_scatter_hz(beat) is None
    assert lock_group(beat, 12.5) is None
    still = SimpleNamespace(
        clamping=0, time_s=np.arange(4.0), turn_rad=np.zeros(3), gap_s=np.ones(3),
        advance_rad=np.zeros(4), advance_error=np.full(4, 1e-3),
    )  # fmt: skip
    usual_hz = usual_scatter_hz(Interference(), 12.5)
    light = phase_turn_group([still], usual_hz, 12.5)
    assert np.sqrt(light.covariance[0, 0]) == pytest.approx(usual_hz / 2)


def test_frames_lost_in_attempts_that_were_repeated_count() -> None:
    fields = {
        "order": 1, "lock_error_hz": 0.01, "lock_error_se_hz": 1e-3, "read_drive_hz": None,
        "drive_hz": 2000, "timestamps_s": (5.0,),
    }  # fmt: skip
    good, dropped = (SimpleNamespace(verdict=v, **fields) for v in (Verdict.OK, Verdict.DROPPED))
    run = SimpleNamespace(steps=[good] * 18 + [dropped], earlier_attempts=(dropped,) * 3,
                          sideband_order=1)  # fmt: skip
    beat = read_step_log([SimpleNamespace(run=run, name="up", clock_s=0.0)])
    assert (beat.steps, beat.lost) == (22, 4)
    assert len(beat.lock_hz) == 18


def camera(levels_dn, noise_dn=3.0):
    """Four frames of every level, of a camera that shows no more than 4095."""
    rng = np.random.default_rng(3)
    frames = [
        np.clip(level + noise_dn * rng.standard_normal((4, 24, 32)), 0, 4095).round()
        for level in levels_dn
    ]
    exposures = [0.02 * (k + 1) for k in range(len(frames))]
    run = SimpleNamespace(
        path=Path("lamp.h5"), saturation_dn=4095, frames=lambda position: frames[position],
        exposure_of=lambda step: exposures[step.position],
        steps=[SimpleNamespace(position=k, verdict=Verdict.OK) for k in range(len(frames))],
    )  # fmt: skip
    return [SimpleNamespace(run=run)]


def test_saturated_flats_do_not_count() -> None:
    flat = read_flat(camera([1000, 1950, 5000, 5000]), 50.0)
    assert flat.exposure_s.tolist() == [0.02, 0.04]
    assert flat.signal_dn == pytest.approx([950, 1900], abs=1)
    assert read_flat(camera([5000, 5000]), 50.0) is None


def test_dark_frames_that_never_change_are_of_no_camera() -> None:
    with pytest.raises(FitInputError, match=r"lamp\.h5: no pixel of the dark frames ever changes"):
        read_dark(camera([50], noise_dn=0.0))


def test_light_is_compared_where_all_sweeps_have_frequencies() -> None:
    low, high = STEPS_HZ[:120], STEPS_HZ[60:]
    light = brightness_group([sweep("low", low), sweep("high", high)], [])
    assert 4 <= len(light.values) < 16
    assert np.abs(light.values).max() < 0.02
    apart = brightness_group([sweep("low", STEPS_HZ[:80]), sweep("high", STEPS_HZ[100:])], [
        SimpleNamespace(clamping=0, brightness=np.zeros(1), run=np.zeros(1, int),
                        run_time_s=np.ones(1))])  # fmt: skip
    assert [place.quantity for place in apart.coordinates] == ["order 0"]


def test_programs_that_tell_one_noise_for_all_are_believed_but_for_little() -> None:
    noise = noise_group([sweep(noise_dn2=np.full(184, 1e3))], dark_dn=2.0)
    assert noise.values == pytest.approx(np.log(1e3))
    assert np.linalg.eigvalsh(noise.covariance).min() > 0


def test_where_no_hologram_is_known_fringes_say_nothing() -> None:
    blind = sweep(off=np.ones(184, bool))
    assert fringe_group([blind]) is None
    assert mixing_in([blind]) == 0.0
    both = fringe_group([blind, sweep("down")])
    assert both.values == pytest.approx(fringe_group([sweep("down")]).values)


def test_frequencies_that_differ_by_what_a_generator_misses_are_one() -> None:
    missed = STEPS_HZ * (1 + 2e-6 * np.sin(np.arange(184)))
    up, down = sweep("up", volts=16.0), sweep("down", missed, volts=16.0)
    quiet = sweep("quiet", missed[::-1][::-1], volts=4.0)
    same = excitation_group([up, sweep("down", volts=16.0)], BenchParameters(), NO_LEAKS)
    assert excitation_group([up, down], BenchParameters(), NO_LEAKS).values == pytest.approx(
        same.values, abs=1e-6
    )
    level = level_group([up, down, quiet], NO_LEAKS)
    assert level.values == pytest.approx(np.zeros(len(level.values)), abs=1e-4)
    assert len(level.values) == 12


@pytest.mark.parametrize("step_hz", [5.0, 10.0, 25.0])
def test_steps_of_one_sweep_are_never_one_however_narrow_they_are(step_hz: float) -> None:
    hz = np.arange(9000.0, 12000.0, step_hz)
    drive = 0.3 * np.sin(hz / 100)
    fine = [
        sweep(name, hz, volts=16.0, log_drive=drive, log_drive_covariance=np.diag(0 * hz))
        for name in ("up", "down")
    ]
    found, mean, _, _ = mean_drive(fine)
    assert found == pytest.approx(hz)
    assert mean == pytest.approx(drive)
    # A generator that is two millionths off plays the same frequencies.
    fine[1] = sweep(
        "down", hz * (1 + 2e-6), volts=16.0, log_drive=drive,
        log_drive_covariance=np.diag(0 * hz),
    )  # fmt: skip
    assert len(mean_drive(fine)[0]) == len(hz)


def test_sweeps_at_other_frequencies_tell_no_lines_and_no_levels() -> None:
    between = STEPS_HZ * 2 ** (1 / 96)
    up, quiet = sweep(volts=16.0), sweep("quiet", between, volts=4.0)
    assert excitation_group([up, quiet], BenchParameters(), NO_LEAKS) is None
    assert level_group([up, quiet], NO_LEAKS) is None


def test_lines_of_the_drive_go_by_the_volts_of_the_loudest_sweep() -> None:
    quiet, loud = sweep("quiet", STEPS_HZ[1:], volts=2.0), sweep("loud", volts=16.0)
    found = excitation_group([quiet, loud], BenchParameters(), NO_LEAKS)
    assert found.values == pytest.approx(
        excitation_group([loud, quiet], BenchParameters(), NO_LEAKS).values, abs=1e-9
    )


def test_sweeps_without_common_modes_tell_none() -> None:
    high = sweep("high", names=("X9",))
    assert (
        modes_group(
            [sweep(), high, sweep("down")], FewModes(), NO_LEAKS, BenchParameters()
        ).values.size
        == 16
    )
    assert modes_group([sweep(names=("X9",))], FewModes(), NO_LEAKS, BenchParameters()) is None
    assert force_group([sweep(), high], FewModes(), BenchParameters()) is None


def test_names_are_in_the_order_of_most_sweeps() -> None:
    hz = np.array([3000.0, 2000.0])
    sweeps = [sweep(name, names=("F1", "T1"), hz=hz) for name in ("up", "down")]
    sweeps.append(sweep("odd", names=("F1", "X1"), hz=np.array([1000.0, 2500.0])))
    assert names_in_order(sweeps) == ["T1", "X1", "F1"]
    assert names_in_order([]) == []


def test_the_model_of_a_campaign_knows_the_order_of_its_modes(monkeypatch) -> None:
    def built(_readings, solver):
        asked.append(solver)
        return []

    asked: list[tuple[str, list[str]]] = []
    monkeypatch.setattr(campaign_diagnosis, "observable_groups", built)
    solver = SimpleNamespace(in_order=lambda names: ("ordered", names))
    readings = SimpleNamespace(
        sweeps=[sweep(names=("X1", "L1"), hz=np.array([7e3, 6.4e3]))],
    )
    inference_problem(readings, solver, BenchParameters())
    assert asked == [("ordered", ["L1", "X1"])]


@pytest.mark.parametrize("place", [0, 1, 3])
def test_a_poor_sweep_takes_no_mode_from_the_others(place: int) -> None:
    """Such as a first one at too few volts, whose fit is a hundred times less sure."""
    good = [sweep(name) for name in ("up", "down", "again")]
    poor = sweep("trial", names=("F1",), covariance=1e-4 * np.eye(2))
    every = [*good[:place], poor, *good[place:]]
    assert common_modes(every) == list(MODES)
    found = modes_group(every, FewModes(), NO_LEAKS, BenchParameters())
    assert len(found.values) == 2 * (3 * len(MODES) + 1)
    (fit,) = (one for one in found.errors.nuisances if one.name == "fit")
    # What sweeps have in common is the error of a good fit.
    alone = modes_group(good, FewModes(), NO_LEAKS, BenchParameters())
    (own,) = (one for one in alone.errors.nuisances if one.name == "fit")
    assert 0 < np.abs(fit.columns).max() < 1.3 * np.abs(own.columns).max()
    missing = _missing(SimpleNamespace(missing=[]), BenchFile.from_file(), every, [])
    assert missing == []


def test_frames_that_cannot_be_used_are_named() -> None:
    def campaign(*kinds):
        return SimpleNamespace(of_kind=lambda kind: [kind] if kind in kinds else [])

    every = campaign(RunKind.FLAT, RunKind.LO_ONLY)
    flat, lo = _unread(every, None, None)
    assert flat.startswith("flat frames")
    assert lo.startswith("frames of the local oscillator")
    assert _unread(every, SimpleNamespace(), SimpleNamespace()) == []
    assert _unread(campaign(), None, None) == []


def test_what_runs_do_not_tell_though_they_are_there_is_missing() -> None:
    sweeps = [sweep(), sweep("high", names=("X7", "X8", "F1")), sweep("down")]
    found = _missing(SimpleNamespace(missing=["dark frames"]), None, sweeps, ["flat frames"])
    assert found[0] == "dark frames"
    assert found[1].startswith("instruments.camera.data_sheet")
    assert found[2] == "flat frames"
    assert "modes of high" in found[3]
    assert len(found) == 4
    bench = BenchFile.from_file()
    assert _missing(SimpleNamespace(missing=[]), bench, sweeps[:1], []) == []


def test_steps_far_apart_tell_how_far_a_mode_moves_by_the_nearest() -> None:
    coarse = 1000.0 * 2 ** (np.arange(24) / 6)
    deep = np.where(np.abs(coarse - 1800) == np.abs(coarse - 1800).min(), 20.0, 0.0)
    modes = modes_group(
        [sweep(drive_hz=coarse, deepest_rad=deep)], FewModes(), NO_LEAKS, BenchParameters()
    )
    parameters = BenchParameters()
    hard = BenchParameters(environment=type(parameters.environment)(hardening=1e-3))
    moved = modes.predict(hard) - modes.predict(parameters)
    assert [place.mode for place, by in zip(modes.coordinates, moved, strict=True) if by] == ["F1"]


def dark_clamp(signal):
    """A run of a reed whose clamp shows a given ratio of light to noise."""
    x_m, y_m = np.linspace(0, 38e-3, 90), np.linspace(-5e-3, 5e-3, 31)
    rng = np.random.default_rng(1)

    def complex_normal():
        drawn: np.ndarray = rng.standard_normal((2, len(y_m), len(x_m)))
        return drawn[0] + 1j * drawn[1]

    light = signal * complex_normal()
    reed = ReedGeometry()
    run = SimpleNamespace(
        x_m=x_m, y_m=y_m, sideband_order=1, frames=lambda position: position,
        reed_file=lambda: SimpleNamespace(geometry=lambda: reed),
        field=lambda _position: 0.01 * light + complex_normal(),
        reconstruction=SimpleNamespace(
            quadratures=lambda _frames: SimpleNamespace(field=light + complex_normal(), noise=2.0)
        ),
    )  # fmt: skip
    steps = [SimpleNamespace(position=k, order=1, noise_level=2.0, volts=4.0) for k in range(8)]
    return SimpleNamespace(name="up", run=run, clamping=0, good_steps=steps)


def test_a_clamp_without_light_gives_no_carrier() -> None:
    assert not read_carriers([dark_clamp(0.0)], [dark_clamp(0.0)])
    assert len(read_carriers([dark_clamp(10.0)], [dark_clamp(10.0)])) == 1


def test_sweeps_without_good_steps_tell_of_no_carrier() -> None:
    empty = dark_clamp(10.0)
    empty.good_steps = []
    assert not read_carriers([empty], [dark_clamp(10.0)])


@pytest.mark.parametrize(("field", "noise"), [(np.nan, 1.0), (1.0, 0.0), (1.0, np.nan)])
def test_holograms_that_are_no_numbers_are_refused_by_name(field, noise) -> None:
    step = SimpleNamespace(position=0, index=7, noise_level=noise)
    run = SimpleNamespace(path=Path("up.h5"), field=lambda _position: np.full((2, 2), field))
    blocks = SimpleNamespace(x_m=np.zeros(1), high=2, wide=2, of=lambda field: field.reshape(1, 4))
    with pytest.raises(FitError, match=r"up\.h5: step 7 has verdict ok"):
        _holograms(run, [step], blocks, None)


def test_light_at_rest_is_read_in_the_order_of_time() -> None:
    """The first step is measured last: its shutter was closed."""
    begun_s, turn_hz = [3.0, 1.0, 2.0], 0.01
    rng = np.random.default_rng(2)
    light = 50 * (rng.standard_normal((6, 5)) + 1j * rng.standard_normal((6, 5)))

    def quadratures(frames):
        turned = light * np.exp(2j * np.pi * turn_hz * frames[0, 0, 0])
        return SimpleNamespace(field=turned, noise=0.0)

    phase = SimpleNamespace(error_rad=0.0, standard_error_rad=1e-3)
    run = SimpleNamespace(
        frames=lambda position: np.full((4, 6, 5), begun_s[position]),
        reconstruction=SimpleNamespace(
            quadratures=quadratures, steady_turn=lambda _frames, _halves: phase
        ),
    )
    steps = [
        SimpleNamespace(position=k, timestamps_s=(at,), difference_hz=0.0)
        for k, at in enumerate(begun_s)
    ]
    part = SimpleNamespace(run=run, clamping=0, clock_s=0.0, good_steps=steps)
    (still,) = read_rest_holograms([part])
    np.testing.assert_array_equal(still.time_s, [1.0, 2.0, 3.0])
    np.testing.assert_array_equal(still.gap_s, [1.0, 1.0])
    np.testing.assert_allclose(still.turn_rad, 2 * np.pi * turn_hz, rtol=1e-9)
