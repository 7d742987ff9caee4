"""All groups together, and the slow parts on meshes that are too coarse to be right."""

import json
from dataclasses import replace

import numpy as np
import pytest

from physics.reed.cane.material import Cane
from physics.reed.elements.mesh import FAST
from physics.reed.geometry import ReedGeometry
from physics.reed.reduction.sensitivity import CONSTANTS, MODULI
from reproduction import whole
from reproduction.groups import mesh_evidence, sensitivities
from reproduction.rows import Agreement

# A reed is built, and populations are drawn.
pytestmark = pytest.mark.slow

KEYS = (
    "sweep shape sensitivities metamodel meshes frequencies factors hypotheses cane correlations "
    "out_of_reach"
)


@pytest.fixture(scope="module")
def comparison(models, network, evidence, printed_sensitivities):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(whole, "build_models", lambda announce: models)
        patch.setattr(whole, "gather_evidence", lambda announce: evidence)
        patch.setattr(whole, "compute_table_3", lambda announce: printed_sensitivities)
        patch.setattr(whole, "compute_network", lambda reed: network)
        patch.setattr("reproduction.groups.chain._POPULATIONS", 2)
        return whole.compare_paper(lambda words: None)


def test_all_groups_are_there_and_no_row_twice(comparison):
    assert [group.key for group in comparison.groups] == KEYS.split()
    names = [(row.table, row.quantity) for row in comparison.rows]
    assert len(set(names)) == len(names) > 700


def test_counts_add_up(comparison):
    answer = comparison.to_json()
    assert sum(answer["counts"].values()) == len(comparison.rows)
    for agreement in Agreement:
        parts = [group["counts"][str(agreement)] for group in answer["groups"]]
        assert answer["counts"][str(agreement)] == sum(parts) == comparison.count(agreement)


def test_it_is_json_without_gaps(comparison):
    answer = json.loads(json.dumps(comparison.to_json(), allow_nan=False))
    assert list(answer) == ["counts", "findings", "groups"]
    assert len(answer["findings"]) == 8
    for group in answer["groups"]:
        assert group["title"]
        assert group["method"].endswith(".")


def test_whatever_is_printed_has_a_unit_or_none_at_all(comparison):
    units = {row.unit for row in comparison.rows}
    known = {"", "Hz", "kHz", "cents", "nm", "µm", "mm", "mm³", "%", "MPa", "MPa·s", "min", "s"}
    assert units <= known


def test_meshes_are_solved_and_reported(monkeypatch):
    monkeypatch.setattr(mesh_evidence, "STANDARD", replace(FAST, orders=(3, 2, 2)))
    meshes = ((3e-3, 3e-3, False), (3e-3, 2e-3, False), (3e-3, 3e-3, True))
    monkeypatch.setattr(mesh_evidence, "_MESHES", meshes)
    heard = []
    found = mesh_evidence.gather_evidence(heard.append)
    words = [mesh.words for mesh in found.tetrahedra]
    assert words == [
        "tetrahedra of 3 mm",
        "tetrahedra of 3 mm, 2 mm at the tip",
        "tetrahedra of 3 mm, graded towards the strip",
    ]
    assert heard[1:] == [f"solving {name}" for name in words]
    assert [mesh.uniform for mesh in found.tetrahedra] == [True, False, False]
    for mesh in (*found.tetrahedra, found.converged):
        assert {"F1", "T1", "F2", "T2", "X1", "T3"} <= set(mesh.hz)
        for slopes in mesh.sensitivities.values():
            assert slopes[: len(MODULI)].sum() == pytest.approx(0.5, abs=1e-5)
    assert found.tetrahedra[0].hz["T3"] > found.converged.hz["T3"]
    plain, _, graded = (mesh.points for mesh in found.tetrahedra)
    assert graded > 1.5 * plain


def test_a_value_lies_within_what_meshes_span(evidence):
    def of_t3(mesh):
        return mesh.hz["T3"]

    converged, coarse = evidence.converged.hz["T3"], evidence.tetrahedra[0].hz["T3"]
    assert evidence.spans(0.5 * (converged + coarse), of_t3)
    assert not evidence.spans(0.999 * converged, of_t3)
    assert not evidence.spans(1.001 * coarse, of_t3)
    # A mesh without the mode says nothing.
    assert not evidence.spans(coarse, lambda mesh: mesh.hz["T3"] if mesh.points > 1e4 else None)


def test_table_3_is_computed_with_the_reference_material(monkeypatch):
    """The computation itself is tested in `tests/physics/test_sensitivity.py`."""
    asked = []

    def one_at_a_time(geometry, cane, level, done):
        asked.append((geometry, cane, level))
        for constant in CONSTANTS:
            done(constant)
        return {"F1": np.ones(9)}

    monkeypatch.setattr(sensitivities, "one_at_a_time", one_at_a_time)
    heard = []
    assert list(sensitivities.compute_table_3(heard.append)) == ["F1"]
    assert heard == [f"varied {name} by 10 %" for name in CONSTANTS]
    assert [(geometry, cane) for geometry, cane, _ in asked] == [(ReedGeometry(), Cane())]
