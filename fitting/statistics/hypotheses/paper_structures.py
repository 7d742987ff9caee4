"""The paper's hypotheses H1 to H9 as structures.

H4 and H5 are printed in full (Eqs eq9 to 11). Of the others the text gives the number of
coefficients and a few words; each is read here in a way that has this number.
"""

from dataclasses import replace

import numpy as np

from fitting.statistics.hypotheses.structure import (
    PARAMETER_SIZES,
    PARAMETERS,
    AffineMatrix,
    Structure,
    coefficients_within,
    written,
)
from holography.arrays import Array
from physics.reed.cane.viscoelastic import Series, h4_matrix

# Elastic cane of the reference material's kind, MPa.
_ELASTIC = {"d10": 13500.0, "d12": 1000.0, "d40": 1000.0, "d41": 100.0}
_ELASTIC_HAT = ("d10 0 d12", "0 0 0", "0 0 0", "d40 d41 0", "0 0 0", "0 0 0")
_SERIES_A = ("1 0 0 0 0", "0 1 0 0 0", "0 0 1 0 0", "0 0 0 1 0")


def h1() -> Structure:
    """All reeds equal, in both series: E_L and G_LT, 2 coefficients."""
    start = {name: _ELASTIC[name] for name in ("d10", "d40")}
    return written("H1", ("d10", "0", "0", "d40", "0", "0"), (("1",), ("1",)), start)


def h2() -> Structure:
    """E_L and G_LT of each reed, "independent of the series": 4 coefficients.

    A mean and a standard deviation of each. Read so because four coefficients and two
    uncorrelated components do not let E_L and G_LT vary together.
    """
    same = ("1 0 0", "0 1 0", "0 0 1")
    return written("H2", _ELASTIC_HAT, (same, same), _ELASTIC)


def h3() -> Structure:
    """H2 and drying: a change of both means, and a third component in E_L: 7 coefficients.

    Read as Eq. eq10 without its viscous component and with c22 = 1, so that H2 is contained.
    """
    own = ("1 0 0 0", "0 1 0 0", "0 0 1 0")
    dried = ("1 0 0 0", "c10 1 0 0", "c20 0 1 c23")
    return written(
        "H3", _ELASTIC_HAT, (own, dried), {"c10": 0.5, "c20": -1.0, "c23": 0.5, **_ELASTIC}
    )


def h4() -> Structure:
    """H5 with the ties of Eq. 11: 9 coefficients; starts where the paper ended."""
    hat = (
        "d10    0      d12    d12",
        "d20    0      2*d12  -d12",
        "d30    0      0      0",
        "6*d41  d41    0      0",
        "6*d41  2*d41  0      -2*d41",
        "d60    0      0      0",
    )
    dried = ("1 0 0 0 0", "c10 1 0 0 0", "c20 0 0.5 0 0.5", "c30 0 0 1 0")
    return written("H4", hat, (_SERIES_A, dried), _paper_coefficients())


def _paper_coefficients() -> dict[str, float]:
    """Coefficients of H4 that the paper found, read off the twin's matrices of both series."""
    ambient, dry = (h4_matrix(series) for series in (Series.A, Series.B))
    # M̌ of series A is the identity, so that M of series A is M̂; its e4 has no effect.
    check = np.linalg.lstsq(ambient[:, :4], dry, rcond=None)[0]
    return {
        "c10": check[1, 0],
        "c20": check[2, 0],
        "c30": check[3, 0],
        "d10": ambient[0, 0],
        "d12": ambient[0, 2],
        "d20": ambient[1, 0],
        "d30": ambient[2, 0],
        "d41": ambient[3, 1],
        "d60": ambient[5, 0],
    }


def h5() -> Structure:
    """Eqs eq9 and eq10: 18 coefficients."""
    hat = (
        "d10  0    d12  d13",
        "d20  0    d22  d23",
        "d30  0    0    0",
        "d40  d41  0    0",
        "d50  d51  0    d53",
        "d60  0    0    0",
    )
    dried = ("1 0 0 0 0", "c10 1 0 0 0", "c20 0 c22 0 c24", "c30 0 0 1 0")
    names = "c10 c20 c22 c24 c30 d10 d12 d13 d20 d22 d23 d30 d40 d41 d50 d51 d53 d60"
    return _starting_as_h4(
        written("H5", hat, (_SERIES_A, dried), dict.fromkeys(names.split(), 0.0), held=True)
    )


def h6() -> Structure:
    """Eq. eq5k with every element of M̂ and of M̌ of series B free: 24 + 20 = 44 coefficients.

    The other reading with this number is `h6_constant_dashpots`.
    """
    d = [[f"d{i}{k}" for k in range(4)] for i in range(1, 7)]
    c = [[f"c{i}{k}" for k in range(5)] for i in range(4)]
    names = [name for row in (*c, *d) for name in row]
    hat, dried = [" ".join(row) for row in d], [" ".join(row) for row in c]
    return _starting_as_h4(
        written(
            "H6", hat, (_SERIES_A, dried), dict.fromkeys(names, 0.0), rotatable=(0, 1, 2), held=True
        )
    )


def h6_constant_dashpots() -> Structure:
    """H7 with E3 and G3 the same for all reeds in a series: 60 − 2 · 2 · 4 = 44 coefficients."""
    constant = [f"M3{k}" for k in range(1, 5)]
    return _linear("H6 (constant dashpots)", tuple(constant))


def h7() -> Structure:
    """Every parameter of each series linear in four components (Eq. eq.LRE): 12 · 5 = 60."""
    return _linear("H7")


def h8() -> Structure:
    """H7, and all coefficients of Eq. 1 adjusted: 60 + 66."""
    return replace(h7(), name="H8", all_of_equation_1=True)


def h9(mean_parameters: Array) -> Structure:
    """All twelve parameters of every reed free, and all coefficients of Eq. 1: 66.

    "No multiple regression is used", so nothing is common to the reeds; the components are the
    parameters themselves, counted from the population's mean in units of `PARAMETER_SIZES`.

    Parameters
    ----------
    mean_parameters : (2, 6) float
        Means of v over the reeds, per series.
    """
    count = len(PARAMETERS)
    check = np.zeros((2, count, 2 * count + 1))
    check[:, :, 0] = mean_parameters
    for s in range(2):
        check[s, :, 1 + s * count : 1 + (s + 1) * count] = np.diag(PARAMETER_SIZES)
    return Structure(
        "H9",
        coefficients=(),
        start=np.zeros(0),
        hat=AffineMatrix(np.eye(count), np.zeros((0, count, count))),
        check=AffineMatrix(check, np.zeros((0, *check.shape))),
        orthonormal=False,
        all_of_equation_1=True,
    )


def _linear(name: str, left_out: tuple[str, ...] = ()) -> Structure:
    """Both M free but for the elements left out, which are 0."""
    size = len(PARAMETERS)
    rows = [
        [
            ["0" if f"M{j}{k}" in left_out else f"M{j}{k}[{s},{modulus}]" for k in range(5)]
            for modulus in ("EL", "GLT")
            for j in (1, 2, 3)
        ]
        for s in "AB"
    ]
    names = [element for matrix in rows for row in matrix for element in row if element != "0"]
    identity = [" ".join(map(str, row)) for row in np.eye(size, dtype=int)]
    check = ([" ".join(row) for row in rows[0]], [" ".join(row) for row in rows[1]])
    return _starting_as_h4(
        written(name, identity, check, dict.fromkeys(names, 0.0), rotatable=(0, 1, 2, 3), held=True)
    )


def _starting_as_h4(wider: Structure) -> Structure:
    narrow = h4()
    return replace(wider, start=coefficients_within(wider, narrow, narrow.start))
