"""What a bench file says of its camera and of effects that the bench is known to have."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.signal import find_peaks

from diagnosis.inference.nuisances import NUISANCES, of_further_resonances
from diagnosis.known_bench import known_effects_of, only_once, sensor_of
from fitting.known_bench import bench_of
from physics.drive import acoustic_gain
from physics.parameters.drive import AcousticResonance
from physics.parameters.optics import Layout
from physics.parameters.sensor import Sensor
from physics.parameters.tree import BenchParameters, with_part
from physics.reed.geometry import ReedGeometry
from protocols.bench import BenchFile
from protocols.bench_parameters import nominal_parameters
from protocols.errors import ProtocolError

SHIPPED = Path(__file__).parents[2] / "protocols" / "benches" / "simulated.yaml"
TEXT = SHIPPED.read_text(encoding="utf-8")
RUN = SimpleNamespace(
    bench_text=TEXT,
    reconstruction=SimpleNamespace(transform=SimpleNamespace(shape=(64, 96), pixel_m=5e-6)),
)


def bench(known: str) -> BenchFile:
    return BenchFile.from_text(f"{TEXT}\nknown: {known}\n", "lab.yaml")


def parameters_with(described: BenchFile | None) -> BenchParameters:
    parameters = BenchParameters()
    for sized in known_effects_of(RUN, described).effects:
        parameters = sized.change(parameters)
    return parameters


def test_effects_are_put_on_the_twin_in_their_units() -> None:
    parameters = parameters_with(
        bench(
            "{synthesizer_detuning: {offset: 20 mHz}, air_load: {fraction: 0.9}, "
            "laser_power_drift: {loss_rate: 0.3 1/h}}"
        )
    )
    assert parameters.clocks.detuning_hz == pytest.approx(0.02)
    assert parameters.reed.air_share == pytest.approx(1.9)
    assert parameters.optics.interference.fade_per_h == pytest.approx(0.3)


def test_a_bench_of_which_nothing_is_known_is_the_nominal_twin() -> None:
    nominal = BenchParameters()
    for described in (None, BenchFile.from_text(TEXT)):
        assert parameters_with(described) == nominal
        assert known_effects_of(RUN, described).effects == ()


@pytest.mark.parametrize(
    ("known", "said"),
    [
        ("{gremlins: {fraction: 1.0}}", "known.gremlins is not a known effect"),
        ("{air_load: {shere: 0.9}}", "known.air_load.shere is no size of it; it has fraction"),
        ("{laser_power_drift: {loss_rate: 0.3 1/s}}", "loss_rate: '0.3 1/s' is not in its unit"),
        ("{synthesizer_detuning: {offset: 0.02}}", "synthesizer_detuning.offset: 0.02 has no unit"),
        ("{tip_mass: {mass: -1e-6 kg}}", "tip_mass.mass: '-1e-6 kg' is negative"),
        ("{tip_mass: {mass: .nan}}", "known.tip_mass.mass: nan"),
        ("{air_load: {fraction: .inf}}", "known.air_load.fraction: inf is not a finite number"),
        ("{air_load: {fraction: true}}", "air_load.fraction.float: True should be a valid number"),
        ("{crack: {depth: 50 um, x: 1 m}}", "is outside its range; choose a value from"),
        ("{crack: {depth: 50 um, x: 10 ± 1 mm}}", "x: '10 ± 1 mm' has a standard error"),
        ("{air_load: {fraction: 0.3 ± -0.1}}", "air_load.fraction: '0.3 ± -0.1' is no number with"),
        ("{tip_mass: {mass: 1e-6 ± 1e-6}}", "tip_mass.mass: '1e-6' is not in its unit"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_named_with_its_remedy(known: str, said: str) -> None:
    with pytest.raises(ProtocolError) as error:
        known_effects_of(RUN, bench(known))
    assert said in str(error.value)
    assert str(error.value).startswith("lab.yaml:")


def test_a_camera_is_as_its_data_sheet_says() -> None:
    sheet = "{offset_dn: 20, gain_e_dn: 2.0, read_noise_e: 5.0, full_well_e: 30000}"
    shipped = next(line for line in TEXT.splitlines() if "data_sheet:" in line)
    sensor = sensor_of(BenchFile.from_text(TEXT.replace(shipped, f"    data_sheet: {sheet}")), RUN)
    assert (sensor.shape, sensor.pixel_m, sensor.read_noise_e) == ((64, 96), 5e-6, 5.0)
    assert sensor_of(None, RUN).read_noise_e == Sensor().read_noise_e
    # Without it, digital numbers cover the full well, however many there are.
    for bits in (8, 12, 16):
        unknown = TEXT.replace(f"{shipped}\n", "").replace("bits: 12", f"bits: {bits}")
        sensor = sensor_of(BenchFile.from_text(unknown), RUN)
        full_dn = sensor.offset_dn + sensor.full_well_e / sensor.gain_e_dn
        assert full_dn / 2**bits == pytest.approx(4050 / 4096)


def test_a_run_without_a_readable_bench_says_nothing_of_it() -> None:
    assert bench_of(RUN) == BenchFile.from_text(TEXT)
    assert bench_of(SimpleNamespace(bench_text="")) is None


def test_what_a_twin_cannot_have_twice_is_not_asked_for_again() -> None:
    described = bench("{second_acoustic_resonance: {strength: 0.1}, drying: {fraction: 0.2}}")
    known = known_effects_of(RUN, described).effects
    assert only_once(known) == ("second_acoustic_resonance",)
    # A phase that the file does not name is that of a chamber behind an opening.
    assert known[0].values["phase"] == 0.0
    assert only_once(()) == ()


def test_a_size_with_a_standard_error_keeps_it_in_its_unit() -> None:
    described = bench(
        "{laser_power_drift: {loss_rate: 0.3 ± 0.1 1/h}, defocus: {distance: 5 +- 2 mm}, "
        "air_load: {fraction: 0.5}}"
    )
    power, focus, air = known_effects_of(RUN, described).effects
    assert (power.values["loss_rate"], power.errors) == (0.3, {"loss_rate": 0.1})
    assert focus.values["distance"] == pytest.approx(5e-3)
    assert focus.errors["distance"] == pytest.approx(2e-3)
    assert air.uncertain == ()
    moved = focus.change(BenchParameters(), (2.0,))
    assert moved.optics.layout.defocus_m == pytest.approx(9e-3)


def test_a_size_that_cannot_be_negative_is_no_less_than_nothing() -> None:
    (mass,) = known_effects_of(RUN, bench("{tip_mass: {mass: 1e-7 ± 1e-7 kg}}")).effects
    assert mass.change(BenchParameters(), (-3.0,)) == BenchParameters()
    assert mass.change(BenchParameters(), (3.0,)) != BenchParameters()


def test_effects_are_foreseen_if_the_runs_were_measured_with_them() -> None:
    described = bench("{drying: {fraction: 0.2}}")
    measured = SimpleNamespace(**{**vars(RUN), "bench_text": described.text})
    assert known_effects_of(measured).foreseen
    assert known_effects_of(measured, described).foreseen
    assert not known_effects_of(RUN, described).foreseen


LINES = {"no line": (), "one": (4308.6,), "three": (4308.6, 9000.0, 12500.0)}


@pytest.mark.parametrize("listed", LINES.values(), ids=LINES)
def test_a_bench_has_the_acoustic_resonances_that_its_file_lists_and_no_other(listed) -> None:
    layout, sensor = Layout(), Sensor()
    nominal = nominal_parameters(
        layout, sensor, geometry=ReedGeometry(), chamber="asymmetric", series="A",
        resonances_hz=listed,
    )  # fmt: skip
    hz = np.geomspace(2e3, 16e3, 4000)
    gain = np.abs(acoustic_gain(nominal.drive, hz))
    peaks = hz[find_peaks(gain, prominence=0.5)[0]]
    # Poles, and peaks next to them: a path in parallel adds to what passes below it.
    assert peaks == pytest.approx(listed, rel=0.02)
    if not listed:
        assert gain == pytest.approx(np.ones(len(hz)))


def test_each_listed_resonance_is_uncertain_by_itself() -> None:
    lines = tuple(AcousticResonance(frequency_hz=hz) for hz in (9e3, 12.5e3))
    nominal = with_part(BenchParameters(), "drive", further_resonances=lines)
    nuisances = {each.name: each for each in of_further_resonances(nominal.drive)}
    assert len(nuisances) == 6
    found = nuisances["resonance 3 quality"].change(nominal, np.log(2)).drive.further_resonances
    assert found[0] == lines[0]
    assert found[1].quality == pytest.approx(2 * lines[1].quality)
    assert found[1].strength == lines[1].strength
    first = {each.name: each for each in NUISANCES}
    for what in ("strength", "quality", "frequency"):
        assert nuisances[f"resonance 2 {what}"].spread == first[f"resonance {what}"].spread
