"""The other side: its labels, its hashes, and laboratories that are like the bench."""

import json
from dataclasses import asdict, replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import linalg

pytest.importorskip("skfem", reason="the extra 'blind' is not installed")

from blind.air import air_masses
from blind.cases import (
    Label,
    commitment,
    drawn_label,
    healthy_world,
    seal,
    sick_world,
    stated_sizes,
)
from blind.effects import KINDS
from blind.laboratory import FRAME_S, Laboratory
from blind.optics import CENTRE_M, DISTANCE_M, SIZE_M, WAVELENGTH_M, pitch_m
from blind.reed import Build, make_reed
from blind.run_files import bench_text
from blind.vibration import answerer
from blind.world import World
from fitting.forward import basis_of
from physics.effects.catalogue import BY_ID
from physics.parameters.tree import BenchParameters
from physics.reed.cane.viscoelastic import (
    Components,
    Series,
    storage_modulus_pa,
    viscoelastic_cane,
)
from physics.reed.reduced.elastic import elastic_modes
from protocols.bench import BenchFile
from protocols.bench_parameters import known_effects, with_effects
from protocols.reed import ReedFile

# A laboratory of its own elements is built for them.
pytestmark = pytest.mark.slow


def test_known_kinds_are_those_of_the_catalogue_and_others_are_not() -> None:
    known = {kind.name for kind in KINDS if kind.known}
    others = {kind.name for kind in KINDS if not kind.known}
    assert known <= set(BY_ID)
    assert len(known) >= 30
    assert len(others) >= 10
    assert not others & set(BY_ID)


def test_labels_are_drawn_again_the_same_and_differ_from_number_to_number() -> None:
    labels = [drawn_label(1, number, 5) for number in range(40)]
    assert labels == [drawn_label(1, number, 5) for number in range(40)]
    assert len({label.effects[0][0] for label in labels}) > 15
    sizes = [abs(label.effects[0][1]) for label in labels]
    assert 0.5 <= min(sizes) < 1.5
    assert 3 < max(sizes) <= 8
    assert drawn_label(0, 3, 5).effects == ()
    assert len(drawn_label(3, 3, 5).effects) == 2
    assert not drawn_label(4, 3, 5).known


def test_each_effect_is_withheld_once_while_others_are_known() -> None:
    known = [kind.name for kind in KINDS if kind.known]
    labels = [drawn_label(6, number, 5) for number in range(len(known))]
    assert sorted(label.effects[0][0] for label in labels) == sorted(known)
    for label in labels:
        assert len(label.told) == 3
        assert label.effects[0][0] not in {name for name, _ in label.told}
        assert set(stated_sizes(label)) == {name for name, _ in label.told}


def test_what_a_laboratory_states_is_what_it_has() -> None:
    label = drawn_label(6, 3, 5)
    laboratory = SimpleNamespace(world=sick_world(label))
    bench = BenchFile.from_text(bench_text("case", laboratory, stated_sizes(label)))
    stated = with_effects(BenchParameters(), known_effects(bench), "known")
    world = laboratory.world
    assert stated.reed.air_share == pytest.approx(world.cane.air)
    assert stated.optics.interference.leak == pytest.approx(world.light.leak)
    assert stated.clocks.detuning_hz == pytest.approx(world.clockwork.detuning_hz, rel=1e-4)
    assert stated.sensor.read_noise_e >= BenchParameters().sensor.read_noise_e


def test_sizes_of_known_kinds_are_stated_in_the_terms_of_the_catalogue() -> None:
    well = healthy_world(4)
    for kind in KINDS:
        if kind.sizes is not None:
            sick = kind.change(well, 2.0, np.random.default_rng(0))
            sizes = kind.sizes(well, sick)
            assert set(sizes) <= {parameter.name for parameter in BY_ID[kind.name].sizes}
            assert any(sizes.values())


def _plain(value):
    return json.loads(json.dumps(value))


def test_commitments_tell_nothing_and_fit_one_label_only() -> None:
    labels = [drawn_label(0, number, 1) for number in range(2)] + [drawn_label(1, 0, 1)]
    sealed, key = seal(labels)
    for name, entry in key["cases"].items():
        label = next(one for one in labels if _plain(asdict(one)) == _plain(entry["label"]))
        assert sealed["cases"][name] == commitment(label, entry["salt"])
        assert sealed["cases"][name] != commitment(label, entry["salt"][::-1])
        assert label.effects == () or label.effects[0][0] not in json.dumps(sealed)
    again, _ = seal(labels)
    assert set(again["cases"]).isdisjoint(sealed["cases"])
    assert set(again["cases"].values()).isdisjoint(sealed["cases"].values())
    assert list(sealed["cases"]) == sorted(sealed["cases"])
    assert list(key["cases"]) == sorted(sealed["cases"])


def test_every_kind_changes_the_world_and_nothing_else_of_it() -> None:
    base = healthy_world(7)
    for kind in KINDS:
        changed = kind.change(base, 1.0, np.random.default_rng(0))
        assert changed != base, kind.name
        same = [part for part in ("build", "cane", "air", "clockwork", "light", "chip")
                if getattr(changed, part) == getattr(base, part)]  # fmt: skip
        assert len(same) == 5, kind.name


def test_a_label_makes_one_world() -> None:
    label = drawn_label(3, 2, 9)
    assert sick_world(label) == sick_world(label)
    assert sick_world(label).seed == healthy_world(label.seed).seed


@pytest.fixture(scope="module")
def plain_reed():
    return make_reed(Build())


def test_its_modes_are_those_of_the_twin_but_for_the_elements(plain_reed) -> None:
    reed = basis_of(ReedFile.from_file())
    cane = viscoelastic_cane(Components(), Series.A)
    E, G = (storage_modulus_pa(z, 4000.0) for z in (cane.young_L, cane.shear_LT))
    modes = elastic_modes(reed, float(E), float(G), air_fraction=0.0)
    twin = sorted(mode.frequency_hz for mode in modes.values())
    own = np.sqrt(plain_reed.square) / (2 * np.pi)
    # In a vacuum. The moduli at 4 kHz of both are within 0.5 %; elements differ by some cents.
    cents = 1200 * np.log2(own[:10] / np.array(twin[:10]))
    assert np.abs(cents).max() < 40
    assert np.abs(cents).max() > 0.1


def test_a_reed_answers_most_at_its_resonance(plain_reed) -> None:
    world = World()
    answer = answerer(world, plain_reed)
    vacuum_hz = float(np.sqrt(plain_reed.square[0]) / (2 * np.pi))
    (air,) = air_masses(plain_reed, np.array([vacuum_hz]))
    squares = linalg.eigh(np.diag(plain_reed.square), np.eye(len(air)) + air, eigvals_only=True)
    first = float(np.sqrt(squares[0]) / (2 * np.pi))
    hz = first * 2 ** (np.arange(-300, 301, 25) / 1200)
    moved = [np.abs(answer.deflection(f, 1.0, 0.0, 0.0, 0)[0]) for f in hz]
    peak = hz[int(np.argmax(moved))]
    assert abs(1200 * np.log2(peak / first)) < 150
    twice = answer.deflection(first, 2.0, 0.0, 0.0, 0)
    np.testing.assert_allclose(twice, 2 * answer.deflection(first, 1.0, 0.0, 0.0, 0))


def test_each_point_sends_the_wave_of_its_place() -> None:
    """The sum over one point, by the Fresnel integral; no point is in the middle of a pixel."""
    laboratory = Laboratory(healthy_world(5))
    camera, stage, chip = laboratory.camera, laboratory.stage, laboratory.world.chip
    at = chip.pixel_m * (np.arange(chip.rows) - chip.rows // 2)
    pitch = pitch_m(chip)
    for row, column in ((0, 0), (11, 40), (28, 77)):
        points = np.zeros(stage.inside.shape, complex)
        points[row, column] = 1.0
        y, x = (
            centre_m + at_m[number // 2] + pitch * (0.25 if number % 2 else -0.25)
            for number, at_m, centre_m in (
                (row, stage.y_m, CENTRE_M[0]),
                (column, stage.x_m, CENTRE_M[1] - 0.5 * SIZE_M[1]),
            )
        )
        away2 = (at[:, None] - y) ** 2 + (at - x) ** 2
        wave = np.exp(-1j * np.pi * away2 / (WAVELENGTH_M * DISTANCE_M)) / chip.rows
        assert np.vdot(wave, camera.on_sensor(points)) == pytest.approx(1.0, abs=1e-9)


def test_the_noise_next_to_the_image_is_that_of_the_frames() -> None:
    """Bright light of a reed leaves no side lobes there."""
    laboratory = Laboratory(healthy_world(5))
    camera, rng = laboratory.camera, np.random.default_rng(6)
    field = camera.on_sensor(camera.sidebands(None)[0])
    frames = np.stack([1e4 * (field * 1j**-k).real + 1e6 for k in range(4)])
    _, alone = camera.reconstructed(frames)
    image, noise = camera.reconstructed(frames + 3.0 * rng.standard_normal(frames.shape))
    # Four frames of 9 dn² each.
    assert noise == pytest.approx(36.0, rel=0.1)
    assert alone < 1e-9 * np.mean(np.abs(image) ** 2)


def test_light_at_rest_turns_between_acquisitions_as_fast_as_within_them() -> None:
    label = Label(1, (("synthesizer_drift", 8.0),), True, 5)
    world = sick_world(label)
    still = replace(world.light, walk_rad_s=0.0, jitter_rad=0.0, gain_scatter=0.0)
    laboratory = Laboratory(replace(world, light=still))
    # An hour later: two acquisitions, one after the other. A whole campaign takes half a minute.
    laboratory._now_s = 3600.0  # noqa: SLF001  # nothing else lets an hour pass
    take = laboratory._still  # noqa: SLF001  # a campaign takes all sweeps as well
    shots = [take(number, "order0", FRAME_S) for number in range(2)]
    fields = [laboratory.camera.reconstructed(shot.frames)[0] for shot in shots]
    gap_s = shots[1].began_s - shots[0].began_s
    # Light turns at less than the difference that was set by what the synthesizers drifted.
    turned = np.angle(np.vdot(fields[0], fields[1]) * np.exp(2j * np.pi * gap_s / (4 * FRAME_S)))
    expected = -2 * np.pi * world.clockwork.drift_hz_h * gap_s
    assert world.clockwork.drift_hz_h > 0.3
    assert turned == pytest.approx(expected, abs=0.02)
