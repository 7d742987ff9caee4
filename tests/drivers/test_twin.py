"""The twin's section of a bench file becomes physics, or one line of complaint."""

from dataclasses import replace

import numpy as np
import pytest

from acquire.reed_file import ReedFile
from drivers.context import BenchContext
from drivers.errors import BenchSetupError
from drivers.roles import Preparation
from drivers.simulated.lab import SimulatedLab
from drivers.simulated.twin import Twin, cane_of, read_twin, twin_settings
from physics.air import Filling
from physics.reed.material import Cane
from physics.reed.viscoelastic import Components, Series, require_physical, viscoelastic_cane


def settings_of(bench_file, series="A", chamber="asymmetric", reed="R07"):
    twin = read_twin(bench_file.twin, bench_file.name)
    return twin_settings(twin, bench_file, Preparation(reed, series, chamber))


def test_a_name_is_always_the_same_cane():
    assert cane_of("R07") == cane_of("R07")
    assert cane_of("R07") != cane_of("R08")
    # A literal value: the cane of a name must not change from one version to the next.
    assert cane_of("R07").e1 == pytest.approx(-0.38826242150615703, abs=1e-12)


def test_canes_are_a_standard_normal_population_inside_physics():
    canes = [cane_of(f"reed {number}") for number in range(500)]
    for cane in canes:
        for series in Series:
            require_physical(viscoelastic_cane(cane, series))
    values = np.array([[c.e1, c.e2, c.e3, c.e4] for c in canes])
    # Four standard errors; cutting 2 % of the draws off shifts e1 and e3 by under 0.05.
    assert np.abs(values.mean(axis=0)).max() < 4 / np.sqrt(500) + 0.05
    assert np.abs(values.std(axis=0) - 1).max() < 4 / np.sqrt(1000) + 0.05
    assert np.abs(np.corrcoef(values.T) - np.eye(4)).max() < 4 / np.sqrt(500) + 0.05


def test_the_preparation_decides_moisture_and_chamber(small_bench_file):
    bench_file = small_bench_file()
    a, b = settings_of(bench_file), settings_of(bench_file, "B", "symmetric")
    assert (a.series, b.series) == (Series.A, Series.B)
    assert (a.chamber.filling, b.chamber.filling) == (Filling.ASYMMETRIC, Filling.SYMMETRIC)
    assert a.components == b.components == cane_of("R07")


def test_the_bench_file_decides_optics_sensor_and_reed(small_bench_file):
    bench_file = small_bench_file(
        reed={"e1": 0.5, "e3": -1}, loss_factor=0.05, light={"object_e_s": 100.0}
    )
    settings = settings_of(bench_file)
    assert settings.components == Components(e1=0.5, e3=-1.0)
    assert settings.loss_factor == 0.05
    assert settings.illumination.object_e_s == 100.0
    assert settings.sensor.shape == (1024, 1280)
    assert settings.sensor.pixel_m == 6.7e-6
    assert settings.layout.reed_centre_m == (0.022, 0.0)
    assert settings.layout.wavelength_m == 650e-9


def test_another_reed_has_a_mouthpiece_of_its_own(small_bench_file):
    bench_file, bass = small_bench_file(), ReedFile.from_file("bass-clarinet").geometry()
    preparation = Preparation("R07", "A", "asymmetric", bass)
    settings = twin_settings(read_twin({}, "bench"), bench_file, preparation)
    clarinet = settings_of(bench_file)
    # The paper's mouthpiece, and one with the same walls for a reed that is clamped at 45 mm.
    assert (clarinet.chamber.length_m, clarinet.chamber.half_width_m) == (33e-3, 5.3e-3)
    assert settings.chamber.length_m == pytest.approx(39.8e-3)
    assert settings.chamber.half_width_m == pytest.approx(6.925e-3)
    assert settings.layout.reed_size_m > clarinet.layout.reed_size_m == (0.014, 0.038)


def test_the_laboratory_builds_the_reed_of_the_preparation(small_bench_file, monkeypatch):
    asked = []

    def note(geometry, level, settings, announce):
        asked.append((geometry, settings.cane))

    monkeypatch.setattr("drivers.simulated.lab.reduced_reed", note)
    bass = ReedFile.from_file("bass-clarinet")
    constants = replace(bass.constants(), density_kg_m3=600.0)
    for preparation in (
        Preparation("R07", "A", "asymmetric", bass.geometry(), constants),
        Preparation("R07", "A", "asymmetric"),
    ):
        SimulatedLab(BenchContext(small_bench_file(), preparation, np.random.default_rng(0), print))
    assert asked == [(bass.geometry(), constants), (None, Cane())]


def test_faults_reach_physics(small_bench_file):
    faults = {"tweeter_unplugged": True, "local_oscillator_factor": 4}
    settings, nominal = (settings_of(small_bench_file(**twin)) for twin in ({"faults": faults}, {}))
    assert not settings.tweeter.connected
    assert nominal.tweeter.connected
    ratio = settings.illumination.local_oscillator_e_s / nominal.illumination.local_oscillator_e_s
    assert ratio == 4


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ({"mash": "coarse"}, r"twin\.mash: unknown key"),
        ({"mesh": "fine"}, r"twin\.mesh: .*'standard' or 'coarse', but is 'fine'"),
        ({"loss_factor": 0}, r"twin\.loss_factor: .*greater than 0, but is 0"),
        ({"loss_factor": float("nan")}, r"twin\.loss_factor: .*finite"),
        ({"reed": {"e1": "0"}}, r"twin\.reed\.e1: .*valid number"),
        ({"faults": {"drop_frame_at": 3}}, r"twin\.faults\.drop_frame_at: "),
        ({"pace": "slow", "mesh": 1}, r"\(and 1 more\)"),
    ],
)
def test_a_wrong_twin_is_refused_in_one_line(content, said):
    with pytest.raises(BenchSetupError, match=said) as caught:
        read_twin(content, "mine")
    assert str(caught.value).startswith("bench 'mine': ")
    assert "\n" not in str(caught.value)


def test_components_outside_physics_are_refused(small_bench_file):
    with pytest.raises(BenchSetupError, match=r"twin\.reed: G2 = .*nearer to 0"):
        settings_of(small_bench_file(reed={"e1": -3.5, "e3": 0.0}))


def test_nothing_said_is_nominal():
    assert read_twin({}, "mine") == Twin()
