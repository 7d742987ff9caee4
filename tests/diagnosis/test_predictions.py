"""What may be wrong moves each tap's numbers by what can be worked out by hand."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from diagnosis.observables import drive
from diagnosis.observables.brightness import brightness_group
from diagnosis.observables.carrier import Leaks
from diagnosis.observables.drive import excitation_group, forces_rad, level_group
from diagnosis.observables.frequency_lock import lock_group, lost_frames_group
from diagnosis.observables.light import fringe_group, noise_group
from diagnosis.observables.modes import _prediction
from diagnosis.observables.reed_at_rest import phase_scatter_group, phase_turn_group
from diagnosis.readings.mean_drive import mean_drive
from diagnosis.readings.step_log import StepLog
from diagnosis.readings.templates import TEMPLATES
from physics.parameters.chamber import Chamber, Filling
from physics.parameters.disorder import BY_NAME
from physics.parameters.drive import AcousticResonance
from physics.parameters.optics import Interference, Optics
from physics.parameters.tree import BenchParameters, more, with_cane, with_part

RATE_HZ = 12.4
HOUR = 3600.0


_PATHS = {"interference": "optics.interference"}


def moved(block, **parts):
    """What some fields of parts move a block's numbers by, by its places' names."""
    parameters = BenchParameters()
    for part, fields in parts.items():
        parameters = more(parameters, _PATHS.get(part, part), **fields)
    return changed(block, BenchParameters(), parameters)


def changed(block, before, after):
    """What a block's numbers are moved by from some parameters to others."""
    return block.predict(after) - block.predict(before)


@pytest.fixture(scope="module")
def beat():
    """Forty steps of two sweeps, at 2 and at 10 kHz, an hour apart."""
    return StepLog(
        steps=100, lost=0, lock_hz=np.zeros(40), error_hz=np.full(40, 1e-3),
        drive_hz=np.repeat([2e3, 1e4], 20), time_s=np.repeat([0.0, HOUR], 20),
        sweep=np.repeat([0, 1], 20), names=("up", "down"),
    )  # fmt: skip


def test_locks_miss_by_what_modulators_are_ahead_and_generators_behind(beat) -> None:
    lock = lock_group(beat, RATE_HZ)
    assert [place.time for place in lock.coordinates] == ["up", "down"]
    assert moved(lock, clocks={"detuning_hz": 0.01}) == pytest.approx([0.01, 0.01])
    assert moved(lock, clocks={"detuning_hz_h": 0.2}) == pytest.approx([0.0, 0.2])
    # A generator that runs ahead drives the reed faster: 5 ppm of 2 kHz and 10 kHz.
    assert moved(lock, clocks={"generator_ppm": 5.0}) == pytest.approx([-0.01, -0.05])
    # Of every other step, of 12.4 a second: a third of it looks like a turn. The square of a larger
    # error counts, too: 0.0345 rad of a tenth of a radian.
    assert moved(lock, interference={"quarter_error_rad": 0.001}) == pytest.approx(
        [-6.58e-4] * 2, rel=1e-3
    )
    assert moved(lock, interference={"quarter_error_rad": 0.1}) == pytest.approx(
        [-0.0681] * 2, rel=1e-3
    )


def test_all_locks_may_be_off_by_the_camera_s_clock(beat) -> None:
    """A camera 100 ppm fast turns a quarter turn per frame, 3.1 Hz, by 0.31 mHz."""
    many = replace(beat, error_hz=np.full(40, 1e-7))
    noise = lock_group(many, 12.4).errors.noise
    assert noise[0, 1] == pytest.approx(3.1e-4**2)
    assert noise[0, 0] == pytest.approx(3.1e-4**2, rel=1e-3)


def test_frames_lost_are_counted_on_a_scale_of_even_scatter(beat) -> None:
    # Four of a hundred.
    expected = 2 * (np.sqrt(4 + 3 / 8) - np.sqrt(3 / 8))
    assert moved(lost_frames_group(beat), clocks={"lost_fraction": 0.04}) == pytest.approx(
        [expected]
    )


def still(clamping=0):
    """Six acquisitions at rest, one a second, an hour into a campaign."""
    count = 6
    return SimpleNamespace(
        clamping=clamping, time_s=HOUR + np.arange(count) - 2.5,
        advance_rad=np.zeros(count), turn_rad=0.01 * np.array([1.0, -1, 1, -1, 1]),
        gap_s=np.ones(count - 1), brightness=np.zeros(count), run=np.zeros(count, int),
        run_time_s=np.array([HOUR]),
    )  # fmt: skip


def test_light_at_rest_turns_by_the_modulators_and_by_unequal_steps_only_within() -> None:
    turn = phase_turn_group([still()], 0.05, RATE_HZ)
    within, between = (place.quantity.split(", ")[1] for place in turn.coordinates)
    assert (within, between) == ("within acquisitions", "between acquisitions")
    assert moved(turn, clocks={"detuning_hz": 0.01}) == pytest.approx([0.01, 0.01])
    assert moved(turn, clocks={"detuning_hz_h": 0.2}) == pytest.approx([0.2, 0.2], rel=1e-6)
    assert moved(turn, interference={"quarter_error_rad": 0.1}) == pytest.approx(
        [-0.0681, 0.0], rel=1e-3
    )


def test_phases_scatter_by_what_walks_and_jitters() -> None:
    scatter = phase_scatter_group([still()], 0.05, 40, RATE_HZ)
    # Within: a third of the turn from the first frame to the last, three periods of 1/12.4 s apart,
    # of a walk of 0.05 rad per root second and of jitter in both; between: over a second.
    # Ordinary benches scatter by as much as their walk, jitter and steps make, in quadrature.
    walk, jitter, step = (
        BY_NAME[name].ordinary.root_mean_square
        for name in ("path_walk", "path_jitter", "path_step")
    )
    within = 3 * (0.05**2 + walk**2) / RATE_HZ / 9 + 2 * jitter**2 / 9, 2 * 0.15**2 / 9
    between = 0.05**2 + walk**2 + 0.5 * jitter**2 + step**2, 0.5 * 0.15**2
    expected = [0.5 * np.log(1 + new / old) for old, new in (within, between)]
    assert moved(scatter, interference={"jitter_rad": 0.15}) == pytest.approx(expected)


def test_scatter_of_few_locks_is_uncertain() -> None:
    # By the median of n numbers, the logarithm of a standard deviation has variance 1 / 2 (0.37 n).
    few, many = (
        phase_scatter_group([still()], 0.05, count, RATE_HZ).covariance[0, 0]
        for count in (20, 20_000)
    )
    assert few - many == pytest.approx(0.5 / (0.37 * 20), rel=2e-3)


def sweep(name="up", begun_s=0.0, length_s=0.0, volts=4.0, clamping=0, **own):
    """Reading of a sweep of 160 holograms from 1 to 10 kHz."""
    count = 160
    fields = {
        "name": name, "clamping": clamping, "volts": np.full(count, volts),
        "loudness": float(np.log(volts)), "drive_hz": np.geomspace(1e3, 1e4, count),
        "time_s": begun_s + np.linspace(0, length_s, count), "noise_dn2": np.full(count, 1600.0),
        "fringe_dn2": np.full(count, 1e4), "signal": np.log(volts) + np.zeros(count),
        "log_drive": np.zeros(count), "log_drive_covariance": np.zeros((count, count)),
        "doubtful": np.zeros((0, 2)),
        "off": np.zeros(count, bool), "taken_off": 0.0,
        "deepest_rad": np.full(count, 3.0), "amplitude_rad": np.ones(count),
        "names": (), "hz": np.zeros(0), "loss_factor": np.zeros(0), "stiffening": np.zeros(0),
    }  # fmt: skip
    return SimpleNamespace(**(fields | own))


def test_light_fades_by_its_share_an_hour_and_fringes_by_its_root_of_either_beam() -> None:
    # One sweep at the begin, one an hour later; the light at rest as well.
    light = brightness_group([sweep(), sweep("down", HOUR)], [still()])
    faded = moved(light, interference={"fade_per_h": 0.3})
    when = [place.time for place in light.coordinates]
    rest = next(k for k, time in enumerate(when) if time.startswith("at rest"))
    up, down = ([k for k, t in enumerate(when) if t.startswith(name)] for name in ("up", "down"))
    assert faded[rest] == pytest.approx(-0.3)
    # Sweeps are compared with their mean.
    assert faded[up] == pytest.approx(0.15)
    assert faded[down] == pytest.approx(-0.15)
    hopped = moved(light, interference={"hop": 0.2})
    # Contrast of 0.8 from the half of the campaign on.
    assert hopped[rest] == pytest.approx(np.log(0.8))
    assert hopped[down] - hopped[up] == pytest.approx(np.log(0.8))


def test_noise_is_that_of_the_light_but_for_a_little() -> None:
    # Four frames with a standard deviation of 4 when it is dark are a twenty-fifth of 1600.
    noise = noise_group([sweep(), sweep("down", HOUR)], dark_dn=4.0)
    faded = moved(noise, interference={"fade_per_h": 0.3})
    down = [k for k, place in enumerate(noise.coordinates) if place.time.startswith("down")]
    assert faded[down] == pytest.approx(-0.96 * 0.3)
    assert np.delete(faded, down) == pytest.approx(0.0)


def test_fringes_show_what_leaks_in_by_its_amplitude_and_lost_contrast_as_it_is() -> None:
    there = sweep(template=np.zeros((len(TEMPLATES), 160), complex),
                  template_variance=np.ones((len(TEMPLATES), 160)))  # fmt: skip
    fringes = fringe_group([there])
    assert [place.quantity for place in fringes.coordinates] == [
        "sideband crosstalk",
        "decorrelation",
    ]
    for field in ("crosstalk", "leak"):
        change = moved(fringes, interference={field: 0.03})
        assert change == pytest.approx([np.hypot(0.03, 1e-3) - 1e-3, 0.0])
    assert moved(fringes, interference={"decorrelation_per_rad2": 1e-3}) == pytest.approx(
        [0.0, 1e-3]
    )


def test_a_coil_loses_by_the_square_of_its_volts_where_it_moves() -> None:
    level = level_group([sweep(volts=16.0), sweep("quiet", volts=4.0)], Leaks({}, 0.0))
    change = moved(level, drive={"compression": 0.5})
    # At the least frequency 0.5 / (1 + (1/5)²) of what it would be at 16 V; a sixteenth at 4 V.
    most = 0.5 / (1 + (1.12 / 5) ** 2)
    assert change[0] == pytest.approx(np.log((1 - most) / (1 - most / 16)), abs=0.02)
    assert (np.diff(change) > 0).all()
    assert len(change) > 3


def test_light_that_changes_between_sweeps_is_no_change_of_level() -> None:
    quiet = sweep("quiet", volts=4.0, begun_s=HOUR)
    level = level_group([sweep(volts=16.0), quiet], Leaks({}, 0.0))
    # What moves is seen by the light of its own time: an hour later a tenth, or a fifth, is lost.
    faded = moved(level, interference={"fade_per_h": 0.1})
    assert faded == pytest.approx(np.full(len(faded), 0.1))
    beams = replace(Interference(), hop=0.2, hop_after_h=0.5)
    after = replace(BenchParameters(), optics=replace(Optics(), interference=beams))
    change = changed(level, BenchParameters(), after)
    assert change == pytest.approx(np.full(len(change), -np.log(0.8)))


def test_a_line_stands_out_of_the_drive_where_it_is() -> None:
    # Both right at a hologram's frequency.
    hz = np.geomspace(1e3, 1e4, 160)
    line = AcousticResonance(frequency_hz=float(hz[90]))
    nominal = with_part(BenchParameters(), "drive", acoustic_resonance=line)
    block = excitation_group([sweep(), sweep("down")], nominal, Leaks({}, 0.0))
    at_line, at_second = 90, 130
    second = AcousticResonance(float(hz[at_second]), 20.0, 0.1)
    change = changed(block, nominal, with_part(nominal, "drive", second_resonance=second))
    # Of a quality of 20: at its middle 1 − 2i of the pressure, and hardly anything far below.
    assert change[at_second] == pytest.approx(np.log(abs(1 - 2j)))
    assert abs(change[30]) < 0.15
    # Of the known line 1.5 times as much.
    strength = line.strength * line.quality
    stronger = with_part(nominal, "drive.acoustic_resonance", strength=1.5 * line.strength)
    change = changed(block, nominal, stronger)
    expected = np.log(abs(1 - 1.5j * strength) / abs(1 - 1j * strength))
    assert change[at_line] == pytest.approx(expected)


def test_the_mean_drive_is_that_of_the_levels_it_is_a_mean_of() -> None:
    """A tweeter that compresses at 16 V, and not at 1 V."""
    hz, most = 1000.0, 16.0
    lost = np.log(1 - 0.5 / (1 + (hz / 5000.0) ** 2) * (most / 16.0) ** 2)
    for volts, share in (((most, 1.0), 0.5), ((most, most, most, 1.0), 1.0)):
        sweeps = [sweep(f"{number}", volts=v) for number, v in enumerate(volts)]
        block = excitation_group(sweeps, BenchParameters(), Leaks({}, 0.0))
        change = moved(block, drive={"compression": 0.5})
        assert change[0] == pytest.approx(share * lost, rel=0.02)


def test_what_fits_do_not_know_of_the_drive_is_an_error_of_its_lines() -> None:
    doubt = np.zeros((160, 160))
    doubt[90:93, 90:93] = 0.3**2
    sure = [sweep(), sweep("down")]
    unsure = [sweep(log_drive_covariance=doubt), sweep("down", log_drive_covariance=doubt)]
    before, after = (
        excitation_group(each, BenchParameters(), Leaks({}, 0.0)).errors.noise
        for each in (sure, unsure)
    )
    # Both sweeps err together: the mean is no better than one.
    assert after - before == pytest.approx(doubt)


def test_in_a_notch_of_the_drive_resonances_are_larger() -> None:
    """By as much as the drive is below its level nearby; on a peak they are as elsewhere."""

    def spread(height: float) -> float:
        log_drive = np.zeros(160)
        log_drive[90] = height
        sweeps = [sweep(log_drive=log_drive), sweep("down", log_drive=log_drive)]
        found = excitation_group(sweeps, BenchParameters(), Leaks({}, 0.0)).errors
        (own,) = (n for n in found.nuisances if n.name == "resonances of the loudspeaker")
        return float(np.sum(own.columns[90] ** 2))

    assert spread(-2.0) == pytest.approx(np.exp(4.0) * spread(0.0), rel=0.05)
    assert spread(2.0) == pytest.approx(spread(0.0))


def test_a_mode_that_is_not_identified_may_be_in_the_drive() -> None:
    """Half of it is within the errors; a drive with a peak of the same height elsewhere is not."""
    hz, loss = np.geomspace(1e3, 1e4, 160), 0.03

    def peak(at_hz: float) -> np.ndarray:
        return -0.5 * np.log(np.abs(1 + 1j * loss - (hz / at_hz) ** 2))

    def distance(at_hz: float, doubtful: np.ndarray) -> float:
        sweeps = [sweep(doubtful=doubtful), sweep("down", doubtful=doubtful)]
        noise = excitation_group(sweeps, BenchParameters(), Leaks({}, 0.0)).errors.noise
        return float(peak(at_hz) @ np.linalg.solve(noise, peak(at_hz)))

    none, mode = np.zeros((0, 2)), np.array([[3000.0, loss]])
    assert distance(3000.0, none) > 30
    assert distance(3000.0, mode) < 1
    assert distance(3000.0 * (1 + 0.3 * loss), mode) < 2
    assert distance(6000.0, mode) > 0.8 * distance(6000.0, none)


def test_a_hologram_that_is_off_in_one_sweep_has_the_error_of_the_others() -> None:
    off = np.zeros(160, bool)
    off[90] = True
    sweeps = [
        sweep(log_drive_covariance=np.eye(160), off=off),
        sweep("down", log_drive_covariance=0.25 * np.eye(160)),
        sweep("again", log_drive_covariance=0.25 * np.eye(160)),
    ]
    hz, _, _, fitted = mean_drive(sweeps)
    assert len(hz) == 160
    assert np.diag(fitted)[[89, 90]] == pytest.approx([0.5, 0.25])


def test_errors_of_the_drive_are_a_covariance_whatever_is_off() -> None:
    """Sweeps err in common at all frequencies; the surest one lacks every second hologram."""
    common = np.ones((160, 160))
    sweeps = [
        sweep(log_drive_covariance=4 * common),
        sweep("down", log_drive_covariance=4 * common),
        sweep("again", log_drive_covariance=0.01 * common, off=np.arange(160) % 2 == 0),
    ]
    _, _, _, fitted = mean_drive(sweeps)
    assert np.diag(fitted)[[0, 1]] == pytest.approx([4.0, 8.01 / 3])
    assert np.linalg.eigvalsh(fitted).min() > -1e-9


def test_forces_fall_beyond_an_amplifier_s_corner_and_rise_by_what_clay_lets_through(
    monkeypatch,
) -> None:
    # Modes at 1 and 10 kHz that the left half pushes by 1, the right one by 0.5.
    modes = {"F1": SimpleNamespace(hz=1e3), "F2": SimpleNamespace(hz=1e4)}
    pushes = SimpleNamespace(closed=1.0, by_leak=0.5, without_signs=0.0, deepest=1.0)
    monkeypatch.setattr(drive, "_pushes", lambda *_: pushes)
    reed_solver = SimpleNamespace(modes=lambda _reed: modes)
    nominal = BenchParameters(chamber=Chamber(filling=Filling.ASYMMETRIC))

    def with_wavelength(wavelength_m):
        return with_part(nominal, "optics.layout", wavelength_m=wavelength_m)

    force = forces_rad(reed_solver, with_wavelength(650e-9))
    usual = force(nominal, tuple(modes))
    # With the corner at 10 kHz, of a low-pass of second order: 1/√2 there, 1/√(1 + 10⁻⁴) at 1 kHz.
    cut = force(more(nominal, "drive", roll_off=1.0), tuple(modes))
    assert cut / usual == pytest.approx([1 / np.sqrt(1 + 1e-4), 1 / np.sqrt(2)])
    opened = force(more(nominal, "chamber", leak=0.6), tuple(modes))
    assert opened / usual == pytest.approx([1.3, 1.3])
    # As far as light tells: 4π over the wavelength.
    half = forces_rad(reed_solver, with_wavelength(325e-9))
    assert half(nominal, tuple(modes)) == pytest.approx(2 * usual)


NAMES, BENDING = ("F1", "T1"), np.array([0.9, 0.2])
GROWN = 0.2
# Of log frequencies by the logs of E_L, G_LT, and the other moduli.
ACROSS = np.array([0.02, 0.1])
MOVED = np.stack([0.5 * BENDING, 0.5 * (1 - BENDING), ACROSS], axis=1)


def of_moduli(reed):
    """Modes whose squared frequencies go with E_L and G_LT by their shares of bending."""
    log = BENDING * reed.shift.E_L + (1 - BENDING) * reed.shift.G_LT
    hz = np.array([2e3, 5e3]) * np.exp(0.5 * log) * (1 - 0.01 * (reed.air_share - 1))
    grown = GROWN + BENDING * reed.shift.growth_E_L + (1 - BENDING) * reed.shift.growth_G_LT
    return {
        n: SimpleNamespace(hz=f, loss_factor=0.03, stiffening=g)
        for n, f, g in zip(NAMES, hz, grown, strict=True)
    }


@pytest.fixture(scope="module")
def modes():
    """Predict cents, then losses in per cent, of two modes at rest for 1 h 40 min, at 10 rad."""
    one = sweep(begun_s=6000.0, names=NAMES, hz=np.array([2e3, 5e3]),
                stiffening=np.full(2, GROWN), deepest_rad=np.full(160, 10.0))  # fmt: skip
    rows = [(0, name, what) for what in ("frequency, cents", "loss, %") for name in NAMES]
    predict = _prediction(rows, NAMES, [one], SimpleNamespace(modes=of_moduli), MOVED)
    return lambda parameters: predict(parameters) - predict(BenchParameters())


def test_frequencies_are_in_cents_and_losses_in_per_cent(modes) -> None:
    # An octave is 1200 cents; a hundredth lower 17.4.
    air = modes(with_part(BenchParameters(), "reed", air_share=2.0))
    assert air == pytest.approx([1200 * np.log2(0.99)] * 2 + [0.0, 0.0])
    stiffer = modes(with_cane(BenchParameters(), E_L=0.02))
    assert stiffer == pytest.approx([1200 * np.log2(np.exp(0.01 * b)) for b in BENDING] + [0, 0])


def test_losses_are_those_that_a_fit_states_whose_cane_grows_otherwise(modes) -> None:
    """Of a resonance, the loss factor over 2 less the growth of its stiffness is seen."""
    stiffer = modes(with_cane(BenchParameters(), growth_E_L=0.1, growth_G_LT=-0.05))
    grown = GROWN + BENDING * 0.1 - (1 - BENDING) * 0.05
    assert stiffer[2:] == pytest.approx(100 * np.log((2 - GROWN) / (2 - grown)))
    assert stiffer[:2] == pytest.approx([0.0, 0.0])


def test_a_fit_that_takes_another_growth_states_another_loss() -> None:
    rows = [(0, "F1", "loss, %"), (1, "F1", "loss, %")]
    sweeps = [
        sweep(begun_s=0.0, names=("F1",), hz=np.array([2e3]), stiffening=np.array([each]))
        for each in (GROWN, 0.0)
    ]
    predict = _prediction(rows, ["F1"], sweeps, SimpleNamespace(modes=of_moduli), MOVED[:1])
    own, elastic = predict(BenchParameters())
    assert own == pytest.approx(100 * np.log(0.03))
    assert elastic - own == pytest.approx(100 * np.log(2 / (2 - GROWN)))


def storage(spring, arm, dashpot):
    """Storage moduli of a Zener solid at the two modes' frequencies (paper, Eq. 4)."""
    moved = (2 * np.pi * np.array([2e3, 5e3]) * dashpot) ** 2
    return spring + arm * moved / (arm**2 + moved)


# Springs and dashpots of the mean reed in series A, and changes of the springs to series B, by the
# coefficients of hypothesis H4 (paper, section IV.B).
E_A, G_A = (10300.0, 7309.0, 0.2822), (115.7 * 6, 115.7 * 6, 0.02038)
E_DRY = (640.5 * (-2.197 + 0.8294), 640.5 * (2 * -2.197 - 0.8294))
G_DRY = (115.7 * 1.011, 2 * 115.7 * (1.011 - 0.8294))


def test_warmth_shifts_the_relaxation_and_takes_its_share_of_the_loss(modes) -> None:
    # Three degrees an hour for 100 minutes: five. With 13 kJ/mol, from 293.15 K.
    shift = np.exp(13e3 / 8.314462618 * (1 / 298.15 - 1 / 293.15))
    E, G = (
        np.log(storage(spring, arm, shift * dashpot) / storage(spring, arm, dashpot))
        for spring, arm, dashpot in (E_A, G_A)
    )
    warm = modes(more(BenchParameters(), "environment", warming_c_h=3.0))
    log = 0.5 * (BENDING * E + (1 - BENDING) * G)
    assert warm[:2] == pytest.approx(1200 * log / np.log(2), rel=1e-6)
    assert warm[2:] == pytest.approx([5.0, 5.0])
    softer = {"warm_E_L": -2e-3, "warm_G_LT": 1e-3}
    more_of_it = modes(more(BenchParameters(), "environment", warming_c_h=3.0, **softer))
    log = 0.5 * (BENDING * -2e-3 + (1 - BENDING) * 1e-3) * 5
    assert (more_of_it - warm)[:2] == pytest.approx(1200 * log / np.log(2), rel=1e-6)


def test_drying_moves_the_cane_towards_series_b_by_the_share_that_is_gone(modes) -> None:
    dry = modes(more(BenchParameters(), "environment", drying=0.5))
    # Four times 1500 s have gone: all but e⁻⁴ of it.
    share = 0.5 * (1 - np.exp(-4))
    E, G = (
        np.log(
            storage(spring + share * more_spring, arm + share * more_arm, dashpot)
            / storage(spring, arm, dashpot)
        )
        for (spring, arm, dashpot), (more_spring, more_arm) in ((E_A, E_DRY), (G_A, G_DRY))
    )
    log = 0.5 * (BENDING * E + (1 - BENDING) * G)
    assert dry[:2] == pytest.approx(1200 * log / np.log(2), rel=1e-6)
    assert dry[2:] == pytest.approx(-15 * share)


def test_other_moduli_follow_what_the_law_of_wood_leaves_open(modes) -> None:
    law = {"dry_others": 0.1, "warm_others": -4e-3}
    still = modes(more(BenchParameters(), "environment", drying=0.5, warming_c_h=3.0))
    changed = modes(more(BenchParameters(), "environment", drying=0.5, warming_c_h=3.0, **law))
    log = 0.1 * 0.5 * (1 - np.exp(-4)) - 4e-3 * 5
    assert (changed - still)[:2] == pytest.approx(1200 * ACROSS * log / np.log(2))
    assert (changed - still)[2:] == pytest.approx([0.0, 0.0])


def test_hardening_counts_by_the_square_of_the_depth(modes) -> None:
    # 0.7 of what it is at the deepest, of stiffness: half of that of frequency.
    hard = modes(more(BenchParameters(), "environment", hardening=0.01))
    assert hard == pytest.approx([1200 * 0.5 * 0.7 * 0.01 / np.log(2)] * 2 + [0.0, 0.0])
