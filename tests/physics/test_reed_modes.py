"""Frequencies of the reed's modes: the paper's figures, and laws that hold for any body."""

from dataclasses import fields, replace
from itertools import pairwise

import numpy as np
import pytest

from physics.reed.cane.material import Cane, stiffness_terms_pa
from physics.reed.elements.fem import (
    Symmetry,
    assemble,
    free_dofs,
    lowest_modes,
    mass,
    stiffness,
)
from physics.reed.elements.mesh import MeshLevel, build_mesh
from physics.reed.geometry import ReedGeometry
from physics.reed.mode_classification import PAPER_MODES
from physics.reed.reduced.elastic import elastic_modes, reduced_modes
from physics.reed.reduced.reed import ReedBox
from tests.numbers import cents

# Eq. 1 of the paper at E_L = 14 GPa, G_LT = 1.1 GPa, and how far (cents) the limit of ever finer
# meshes (`python -m studies.convergence`) lies from it: the paper's 2 mm tetrahedra are stiff.
PAPER_HZ_AND_CENTS = {
    "F1": (2208, -30),
    "T1": (3582, 0),
    "F2": (5207, -31),
    "T2": (6124, 7),
    "X1": (6863, -8),
    "F3": (9831, -33),
    "T3": (9532, -49),
    "X2": (11136, 6),
    "X3": (11941, -53),
    "T4": (14149, -135),
    "F4": (16480, -36),
}
CLASSES = {
    "F": ("F1", "F2", "F3", "F4"),
    "T": ("T1", "T2", "T3", "T4"),
    "X": ("X1", "X2", "X3", "X4", "X5", "X6"),
}
MODULI = {"EL": "E_L_pa", "ET": "E_T_pa", "ER": "E_R_pa"} | {
    "GLT": "G_LT_pa",
    "GLR": "G_LR_pa",
    "GTR": "G_TR_pa",
}
RATIOS = {"nuLT": "nu_LT", "nuLR": "nu_LR", "nuTR": "nu_TR"}


@pytest.fixture(scope="module")
def reference_modes(standard_reed):
    return elastic_modes(standard_reed, 14e9, 1.1e9, air_fraction=0.0)


@pytest.fixture(scope="module")
def sensitivities(standard_reed, reference_modes):
    """``d ln f / d ln c`` for every constant c and mode, by Rayleigh's quotient."""
    answer = {}
    for constant in (f.name for f in fields(Cane) if f.name != "density_kg_m3"):
        value = getattr(Cane(), constant)
        above, below = (
            stiffness_terms_pa(replace(Cane(), **{constant: value * factor}))
            for factor in (1.001, 0.999)
        )
        slope = (above - below) / 0.002
        for name, mode in reference_modes.items():
            parts = standard_reed.parts[mode.symmetry].stiffness_terms
            energy = mode.coordinates @ np.tensordot(slope, parts, axes=1) @ mode.coordinates
            answer[constant, name] = 0.5 * energy / (2 * np.pi * mode.frequency_hz) ** 2
    return answer


@pytest.mark.parametrize("name", PAPER_MODES)
def test_modes_of_the_reference_reed_are_the_papers(name, reference_modes):
    paper_hz, known_cents = PAPER_HZ_AND_CENTS[name]
    assert cents(reference_modes[name].frequency_hz, paper_hz) == pytest.approx(known_cents, abs=10)


def test_the_figures_compared_with_are_the_papers_metamodel(tables):
    metamodel = tables["metamodel"]
    E_p = 14000 ** metamodel["exponent_EL"]
    G_p = 1100 ** metamodel["exponent_GLT"]
    for name, mode in metamodel["modes"].items():
        a = mode["a"]
        interval = a @ np.array([1, E_p, G_p, E_p * G_p, E_p**2, G_p**2])
        hz = metamodel["reference_hz"] * 2 ** (interval / 1200)
        assert PAPER_HZ_AND_CENTS[name][0] == pytest.approx(hz, abs=1)


def test_the_six_moduli_carry_half_of_every_frequency(sensitivities, reference_modes):
    """Stiffness is homogeneous in the moduli of degree one, so ``f² ∝ s`` under a common factor."""
    for name in reference_modes:
        total = sum(sensitivities[modulus, name] for modulus in MODULI.values())
        assert total == pytest.approx(0.5, abs=1e-5)


def test_the_sum_rule_holds_for_solved_frequencies(coarse_mesh, coarse_matrices):
    """The same by solving again with each modulus 1 % up and down."""

    def solve(cane):
        K = stiffness(coarse_matrices, stiffness_terms_pa(cane))[free][:, free]
        return np.log(np.sort(lowest_modes(K, M, 4)[0]))

    free = free_dofs(coarse_mesh, Symmetry.ANTISYMMETRIC)
    M = mass(coarse_matrices, 520.0)[free][:, free]
    total = np.zeros(4)
    for modulus in MODULI.values():
        value = getattr(Cane(), modulus)
        above, below = (replace(Cane(), **{modulus: value * factor}) for factor in (1.01, 0.99))
        total += (solve(above) - solve(below)) / np.log(1.01 / 0.99)
    np.testing.assert_allclose(total, 0.5, atol=2e-4)


@pytest.mark.parametrize("kind", CLASSES)
def test_sensitivities_are_the_papers(kind, sensitivities, tables):
    """Table 3: means over the modes of a class."""
    published = tables["sensitivity_oat_10_percent"]
    for short, constant in (MODULI | RATIOS).items():
        mean = np.mean([sensitivities[constant, name] for name in CLASSES[kind]])
        assert mean == pytest.approx(published[short][kind], abs=0.018), short


def test_young_governs_flexion_and_shear_governs_torsion(sensitivities):
    for name in ("F1", "F2", "F3", "F4"):
        assert sensitivities["E_L_pa", name] > 5 * sensitivities["G_LT_pa", name]
    for name in ("T1", "T2", "T3"):
        assert sensitivities["G_LT_pa", name] > 2 * sensitivities["E_L_pa", name]


def test_frequencies_fall_with_the_root_of_density(coarse_mesh, coarse_matrices, standard_reed):
    free = free_dofs(coarse_mesh, Symmetry.SYMMETRIC)
    K = stiffness(coarse_matrices, stiffness_terms_pa(Cane()))[free][:, free]
    light, heavy = (
        lowest_modes(K, mass(coarse_matrices, rho)[free][:, free], 4)[0] for rho in (400.0, 600.0)
    )
    np.testing.assert_allclose(light / heavy, np.sqrt(1.5), rtol=1e-9)
    heavy_reed = replace(standard_reed, box=ReedBox(Cane(density_kg_m3=2 * 520.0)))
    before, after = (elastic_modes(reed, 14e9, 1.1e9, 0.0) for reed in (standard_reed, heavy_reed))
    for name in PAPER_MODES:
        ratio = before[name].frequency_hz / after[name].frequency_hz
        assert ratio == pytest.approx(np.sqrt(2), rel=1e-9)


def test_finer_meshes_never_raise_frequencies():
    """Degree 2, 3, 4 on the same elements: but for curved sides, each space holds the former."""
    lists = []
    for orders in ((2, 2, 2), (3, 3, 2), (4, 4, 2)):
        mesh = build_mesh(ReedGeometry(), MeshLevel(orders=orders))
        matrices = assemble(mesh)
        found = []
        for symmetry in Symmetry:
            free = free_dofs(mesh, symmetry)
            K = stiffness(matrices, stiffness_terms_pa(Cane()))[free][:, free]
            M = mass(matrices, 520.0)[free][:, free]
            found.append(np.sort(lowest_modes(K, M, 7)[0]))
        lists.append(np.concatenate(found))
    steps = [cents(finer, coarser) for coarser, finer in pairwise(lists)]
    assert np.max(steps) < 1.0
    assert np.abs(steps[1]).max() < 0.3 * np.abs(steps[0]).max()


@pytest.mark.parametrize("stiffer", [(12e9, 1.0e9), (10e9, 1.2e9)])
def test_stiffer_cane_raises_every_mode(stiffer, standard_reed):
    before, after = (elastic_modes(standard_reed, *pair) for pair in ((10e9, 1.0e9), stiffer))
    for name in PAPER_MODES:
        assert after[name].frequency_hz > before[name].frequency_hz


def test_reduced_frequencies_are_those_of_the_mode_table(coarse_reed):
    """`elastic_modes` names what `reduced_modes` finds, and loses nothing."""
    terms = stiffness_terms_pa(replace(coarse_reed.cane, E_L_pa=12e9, G_LT_pa=1e9))
    modes = elastic_modes(coarse_reed, 12e9, 1e9, air_fraction=0.0)
    for symmetry, half in coarse_reed.parts.items():
        found, _ = reduced_modes(half, terms, coarse_reed.cane.density_kg_m3)
        named = sorted(mode.frequency_hz for mode in modes.values() if mode.symmetry is symmetry)
        np.testing.assert_allclose(named, found[: len(named)])
        assert len(named) == 11
