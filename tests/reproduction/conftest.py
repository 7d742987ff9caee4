"""Groups of the comparison from little: few populations, a coarse reed, meshes made up."""

import numpy as np
import pytest

from fitting.paper import constants as paper
from fitting.paper.printed import TABLE_3_CONSTANTS, printed
from physics.reed.elements.mesh import MeshLevel
from physics.reed.mode_classification import PAPER_MODES
from physics.reed.reduced.stored import reduced_reed
from physics.reed.reduction.metamodel import Equation1, paper_network_pa
from physics.reed.reduction.sensitivity import (
    CLASSES,
    CONSTANTS,
    TABLE_3_MODES,
)
from reproduction.groups.mesh_evidence import MeshEvidence, MeshResult
from reproduction.groups.metamodel import Network, reference_hz
from reproduction.models import Models, draw_populations
from reproduction.rows import Agreement


@pytest.fixture(scope="session")
def numbers():
    return printed()


@pytest.fixture(scope="session")
def table_9():
    return Equation1(PAPER_MODES, np.array([paper.TABLE_9[name] for name in PAPER_MODES]))


@pytest.fixture(scope="session")
def models(table_9):
    """Converged finite elements are stood in for by Table 9."""
    adjusted = paper.adjusted_metamodel(PAPER_MODES)
    reed = reduced_reed(level=MeshLevel(orders=(3, 3, 2)))
    return Models(reed, table_9, adjusted, table_9, draw_populations(adjusted, count=4))


@pytest.fixture(scope="session")
def network(table_9):
    """Finite elements that follow Table 9 to a hundredth of a cent."""
    E, G = paper_network_pa()
    off = 1e-3 * np.arange(len(PAPER_MODES))
    return Network(E, G, table_9.evaluate(E[:, None], G[:, None])[0] + off)


@pytest.fixture(scope="session")
def printed_sensitivities(numbers):
    """Sensitivities (9,) of each mode: those that Table 3 prints for its class."""
    table = numbers.sensitivity_oat_10_percent
    return {
        name: np.array([table[key][letter] for key in TABLE_3_CONSTANTS])
        for letter, names in CLASSES.items()
        for name in names
    }


@pytest.fixture(scope="session")
def evidence(table_9, printed_sensitivities):
    """Converged elements 1 % below Table 9 in T3; tetrahedra 2 and 1 % above everywhere."""
    paper_hz = reference_hz(table_9)
    assert tuple(TABLE_3_CONSTANTS.values()) == CONSTANTS

    def mesh(words, points, factor, share, uniform=True):
        hz = {name: factor * value for name, value in paper_hz.items()}
        slopes = {name: share * printed_sensitivities[name] for name in TABLE_3_MODES}
        return MeshResult(words, points, hz, slopes, uniform)

    converged = mesh("converged hexahedra", 15000, 1.0, 0.99, uniform=False)
    converged.hz["T3"] *= 0.99
    return MeshEvidence(
        (
            mesh("tetrahedra of 2 mm", 4900, 1.02, 1.02),
            mesh("tetrahedra of 1.7 mm", 6000, 1.015, 1.01),
            mesh("tetrahedra of 1.5 mm", 7600, 1.01, 1.01),
            mesh("tetrahedra of 2 mm, 1 mm at the tip", 9400, 1.005, 1.0, uniform=False),
        ),
        converged,
    )


@pytest.fixture(scope="session")
def rows_of():
    """Return a function that gives rows by quantity; no two may be called the same."""

    def by_quantity(group):
        rows = {(row.table, row.quantity): row for row in group.rows}
        assert len(rows) == len(group.rows)
        return {quantity: row for (_, quantity), row in rows.items()}

    return by_quantity


@pytest.fixture(scope="session")
def differing():
    """Return a function that lists quantities that are not as printed."""

    def names(group):
        wrong = (Agreement.DIFFERS, Agreement.REFUTED)
        return {row.quantity for row in group.rows if row.agreement in wrong}

    return names
