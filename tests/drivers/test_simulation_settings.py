"""The simulation's section of a bench file becomes physics, or one line of complaint."""

from dataclasses import replace

import numpy as np
import pytest

from drivers.context import BenchContext
from drivers.errors import BenchSetupError
from drivers.simulated.lab import SimulatedLab
from drivers.simulated.settings import (
    Simulation,
    bench_constants,
    bench_geometry,
    bench_parameters,
    cane_of,
    read_simulation,
)
from physics.parameters.chamber import Filling, PressureDistortion
from physics.reed.cane.material import Cane
from physics.reed.cane.viscoelastic import (
    Components,
    Series,
    require_physical,
    viscoelastic_cane,
)
from physics.reed.geometry import ReedGeometry, ThicknessMap
from protocols.preparation import Preparation
from protocols.reed import ReedFile


def settings_of(bench_file, series="A", chamber="asymmetric", reed="R07"):
    simulation = read_simulation(bench_file.twin, bench_file.name)
    return bench_parameters(simulation, bench_file, Preparation(reed, series, chamber))


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
    moist, dry = (viscoelastic_cane(cane_of("R07"), series) for series in (Series.A, Series.B))
    assert (a.reed.cane, b.reed.cane) == (moist, dry)
    assert (a.chamber.filling, b.chamber.filling) == (Filling.ASYMMETRIC, Filling.SYMMETRIC)


def test_the_bench_file_decides_optics_sensor_and_reed(small_bench_file):
    bench_file = small_bench_file(
        reed={"e1": 0.5, "e3": -1}, loss_factor=0.05, light={"object_e_s": 100.0}
    )
    settings = settings_of(bench_file)
    assert settings.reed.cane == viscoelastic_cane(Components(e1=0.5, e3=-1.0), Series.A)
    assert settings.reed.loss_factor == 0.05
    assert settings.optics.illumination.object_e_s == 100.0
    assert settings.sensor.shape == (1024, 1280)
    assert settings.sensor.pixel_m == 6.7e-6
    assert settings.optics.layout.reed_centre_m == (0.022, 0.0)
    assert settings.optics.layout.wavelength_m == 650e-9


def test_another_reed_has_a_mouthpiece_of_its_own(small_bench_file):
    bench_file, bass = small_bench_file(), ReedFile.from_file("bass-clarinet").geometry()
    preparation = Preparation("R07", "A", "asymmetric", bass)
    settings = bench_parameters(read_simulation({}, "bench"), bench_file, preparation)
    clarinet = settings_of(bench_file)
    # The paper's mouthpiece, and one with the same walls for a reed that is clamped at 45 mm.
    assert (clarinet.chamber.length_m, clarinet.chamber.half_width_m) == (33e-3, 5.3e-3)
    assert settings.chamber.length_m == pytest.approx(39.8e-3)
    assert settings.chamber.half_width_m == pytest.approx(6.925e-3)
    assert settings.optics.layout.reed_size_m > clarinet.optics.layout.reed_size_m == (0.014, 0.038)


def test_the_laboratory_builds_the_reed_of_the_preparation(small_bench_file, monkeypatch):
    asked = []

    def note(geometry, level, settings, announce):
        asked.append((geometry, settings.box.cane))

    monkeypatch.setattr("drivers.simulated.lab.reduced_reed", note)
    bass = ReedFile.from_file("bass-clarinet")
    constants = replace(bass.constants(), density_kg_m3=600.0)
    for preparation in (
        Preparation("R07", "A", "asymmetric", bass.geometry(), constants),
        Preparation("R07", "A", "asymmetric"),
    ):
        SimulatedLab(BenchContext(small_bench_file(), preparation, np.random.default_rng(0), print))
    assert asked == [(bass.geometry(), constants), (None, Cane())]


def skew_map(left_um, right_um, y_mm=(-6.5, 6.5)):
    """Return the section of a vamp whose sides are so much thicker than the drawing's."""
    rows = [[right_um, left_um], [right_um, left_um]]
    return {"thickness_map": {"x_mm": [0, 35.0], "y_mm": list(y_mm), "deviation_um": rows}}


def test_the_reed_on_the_bench_differs_from_the_protocols_in_what_is_said():
    bass = ReedFile.from_file("bass-clarinet")
    preparation = Preparation("R07", "A", "asymmetric", bass.geometry(), bass.constants())
    factors = {"E_T": 1.1, "nu_LR": 0.9, "density": 1.2, "E_L": 1.3, "G_LT": 0.7}
    simulation = read_simulation({"shape": skew_map(5, -2.5), "cane_factors": factors}, "mine")
    measured = ThicknessMap((0.0, 35e-3), (-6.5e-3, 6.5e-3), ((-2.5e-6, 5e-6),) * 2)
    geometry = bench_geometry(simulation, preparation)
    assert geometry.thickness_map.deviation_m == pytest.approx(np.array(measured.deviation_m))
    assert geometry.thickness_map.y_m == pytest.approx(measured.y_m)
    assert replace(geometry, thickness_map=None) == bass.geometry()
    known, cane = bass.constants(), bench_constants(simulation, preparation)
    assert cane.E_T_pa == pytest.approx(1.1 * known.E_T_pa)
    assert cane.nu_LR == pytest.approx(0.9 * known.nu_LR)
    assert cane.density_kg_m3 == pytest.approx(1.2 * known.density_kg_m3)
    unchanged = {"E_T_pa": known.E_T_pa, "nu_LR": known.nu_LR}
    assert replace(cane, **unchanged, density_kg_m3=known.density_kg_m3) == known


def test_an_offset_adds_to_what_the_protocol_knows_and_a_map_replaces_it():
    known = ReedGeometry(
        thickness_offset_m=2e-6, thickness_map=ThicknessMap((0.0, 1.0), (0.0, 1.0), ((1.0, 1.0),))
    )
    preparation = Preparation("R07", "A", "asymmetric", known)
    lifted = bench_geometry(
        read_simulation({"shape": {"thickness_offset_um": 3}}, "mine"), preparation
    )
    assert lifted.thickness_offset_m == pytest.approx(5e-6)
    assert lifted.thickness_map == known.thickness_map
    other = bench_geometry(read_simulation({"shape": skew_map(1, 1)}, "mine"), preparation)
    assert other.thickness_offset_m == known.thickness_offset_m
    assert other.thickness_map.x_m == (0.0, 35e-3)


def test_moduli_and_pressure_of_the_bench_reach_physics(small_bench_file):
    settings = settings_of(
        small_bench_file(
            cane_factors={"E_L": 1.1, "G_LT": 0.9}, pressure={"distortion": 0.2, "seed": 5}
        )
    )
    usual = viscoelastic_cane(cane_of("R07"), Series.A)
    assert settings.reed.cane.young_L == usual.young_L.scaled(1.1)
    assert settings.reed.cane.shear_LT == usual.shear_LT.scaled(0.9)
    assert settings.chamber.distortion == PressureDistortion(0.2, 5)


def test_plan_and_chamber_are_those_of_the_reed_that_the_protocol_knows(small_bench_file):
    nominal, wrong = (
        settings_of(small_bench_file(**simulation))
        for simulation in ({}, {"shape": skew_map(9, -9)})
    )
    assert wrong == nominal


@pytest.mark.parametrize("right_um", [5.0, -5.0])
def test_the_laboratory_builds_the_reed_that_differs(right_um, small_bench_file, monkeypatch):
    asked = []
    monkeypatch.setattr(
        "drivers.simulated.lab.reduced_reed",
        lambda geometry, _level, _settings, _announce: asked.append(geometry),
    )
    preparation = Preparation("R07", "A", "asymmetric")
    bench_file = small_bench_file(shape=skew_map(5.0, right_um))
    SimulatedLab(BenchContext(bench_file, preparation, np.random.default_rng(0), print))
    simulation = read_simulation(bench_file.twin, "mine")
    assert asked == [bench_geometry(simulation, preparation)]


@pytest.mark.parametrize(
    ("simulation", "said"),
    [
        ({"shape": skew_map(-500, 0)}, r"twin\.shape and .*µm thick at .*; correct them, or"),
        ({"shape": skew_map(1, 2, y_mm=[0, 6.5])}, r"make no reed: y_mm .* one side of the axis"),
        ({"shape": skew_map(1, 2, y_mm=[-1, 0, 1])}, r"row 1 of deviation_um has 2 values for 3"),
        (
            {"cane_factors": {"nu_TR": 9.0}},
            r"twin\.cane_factors make no reed: .*Poisson ratios",
        ),
    ],
)
def test_a_bench_without_a_possible_reed_is_refused(simulation, said, small_bench_file):
    preparation = Preparation("R07", "A", "asymmetric")
    context = BenchContext(
        small_bench_file(**simulation), preparation, np.random.default_rng(0), print
    )
    with pytest.raises(BenchSetupError, match=said) as caught:
        SimulatedLab(context)
    assert "\n" not in str(caught.value)


def test_faults_reach_physics(small_bench_file):
    faults = {"tweeter_unplugged": True, "local_oscillator_factor": 4}
    settings, nominal = (
        settings_of(small_bench_file(**simulation)) for simulation in ({"faults": faults}, {})
    )
    assert not settings.drive.tweeter.connected
    assert nominal.drive.tweeter.connected
    ratio = (
        settings.optics.illumination.local_oscillator_e_s
        / nominal.optics.illumination.local_oscillator_e_s
    )
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
        ({"shape": {"thickness": 1}}, r"twin\.shape\.thickness: unknown key"),
        ({"shape": {"thickness_map": {"x_mm": [0, 1]}}}, r"thickness_map\.y_mm: is missing"),
        ({"cane_factors": {"E_T": 0}}, r"twin\.cane_factors\.E_T: .*greater than 0"),
        ({"cane_factors": {"E_X": 1.1}}, r"twin\.cane_factors\.E_X: unknown key"),
        ({"pressure": {"distortion": -0.1}}, r"twin\.pressure\.distortion: "),
        ({"pressure": {"seed": 0.5}}, r"twin\.pressure\.seed: "),
        ({"light": {"gain_scatter": 1.0}}, r"twin\.light\.gain_scatter: .*less than 1"),
        ({"light": {"phase_scatter": 1}}, r"twin\.light\.phase_scatter: "),
    ],
)
def test_a_wrong_twin_is_refused_in_one_line(content, said):
    with pytest.raises(BenchSetupError, match=said) as caught:
        read_simulation(content, "mine")
    assert str(caught.value).startswith("bench 'mine': ")
    assert "\n" not in str(caught.value)


def test_components_outside_physics_are_refused(small_bench_file):
    with pytest.raises(BenchSetupError, match=r"twin\.reed: G2 = .*nearer to 0"):
        settings_of(small_bench_file(reed={"e1": -3.5, "e3": 0.0}))


def test_nothing_said_is_nominal():
    assert read_simulation({}, "mine") == Simulation()


def test_an_effect_that_is_played_and_known_is_played_once(small_bench_file):
    preparation = Preparation("R07", "A", "asymmetric")

    def leak(known):
        bench_file = small_bench_file(effects={"carrier_leak": {"fraction": 0.3}}).replace(
            {"known": known}
        )
        settings = read_simulation(bench_file.twin, bench_file.name)
        return bench_parameters(settings, bench_file, preparation).optics.interference

    played = leak({})
    assert leak({"carrier_leak": {"fraction": "0.25 ± 0.1"}}) == played
    assert leak({"laser_power_drift": {"loss_rate": "0.3 1/h"}}) != played
