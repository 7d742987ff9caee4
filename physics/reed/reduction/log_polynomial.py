"""Metamodel of the finite elements: polynomials in the logarithms of E_L and G_LT.

With degree 5 over the range of a reduced basis, a mode that keeps its shape is followed to a
fraction of a cent. Where two modes of one symmetry meet they repel each other and exchange
shapes; a polynomial goes straight through, up to half their distance away from either
(`studies.populations` measures both over the population).
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import NDArray

from holography.arrays import Array
from physics.reed.mode_classification import PAPER_MODES
from physics.reed.reduced.elastic import elastic_modes
from physics.reed.reduced.reed import ReducedReed, ReedBox
from physics.reed.reduction.metamodel import REFERENCE_HZ

# Rounding of a modulus at an edge of its range does not put it outside.
_EDGE = 1e-9
# So far off the others, a mode of the vamp has met one that lends it no similarity (X1 meets L1).
_OTHER_BRANCH_CENTS = 10.0
# A polynomial this close to a mode follows it: a resonance in a sweep of 25-cent steps is known to
# 7 cents.
_FAITHFUL_CENTS = 6.0
# Columns evaluated at a time: the half dozen arrays of a block stay in the processor's cache.
_BLOCK = 1024


@dataclass(frozen=True)
class Box:
    """Ranges of the two moduli, Pa.

    Raises
    ------
    ValueError
        For a range that is empty or reaches zero.
    """

    E_L_pa: tuple[float, float]
    G_LT_pa: tuple[float, float]

    def __post_init__(self) -> None:
        for name, (low, high) in (("E_L", self.E_L_pa), ("G_LT", self.G_LT_pa)):
            if not 0 < low < high:
                raise ValueError(
                    f"{name} from {low:g} to {high:g} Pa is no range of moduli; "
                    "give a positive lower end and a higher upper end"
                )

    def unit(self, E_L_pa: Array, G_LT_pa: Array) -> tuple[Array, Array]:
        """Logarithms scaled to -1 … 1 over the box, each of its modulus' shape."""
        return _unit(E_L_pa, self.E_L_pa), _unit(G_LT_pa, self.G_LT_pa)

    def within(self, E_L_pa: Array, G_LT_pa: Array) -> NDArray[np.bool_]:
        """Whether both moduli lie in the box, edges included; shapes that broadcast."""
        inside = _inside(E_L_pa, self.E_L_pa) & _inside(G_LT_pa, self.G_LT_pa)
        return np.asarray(inside)


REED_BOX = Box(ReedBox().E_L_pa, ReedBox().G_LT_pa)


def _inside(modulus_pa: Array, ends_pa: tuple[float, float]) -> NDArray[np.bool_]:
    low, high = ends_pa
    return np.greater_equal(modulus_pa, low * (1 - _EDGE)) & np.less_equal(
        modulus_pa, high * (1 + _EDGE)
    )


def _unit(modulus_pa: Array, ends_pa: tuple[float, float]) -> Array:
    low, high = np.log(ends_pa)
    unit: Array = np.log(modulus_pa)
    unit *= 2 / (high - low)
    unit -= (high + low) / (high - low)
    return unit


@dataclass(frozen=True)
class Cells:
    """Where polynomials follow their modes: the cells of a grid over a box.

    Attributes
    ----------
    nodes : (k,) float
        Ascending, from -1 to 1 or nearly: the grid's lines for either modulus.
    followed : (m, k - 1, k - 1) bool
        Of each mode, at the places of ln E_L and ln G_LT.
    """

    nodes: Array
    followed: NDArray[np.bool_]


@dataclass(frozen=True)
class LogPolynomial:
    """Cents above F6 as Chebyshev polynomials in ln E_L and ln G_LT of limited total degree.

    A `Metamodel`. Beyond its box the polynomials run on, ever less to be trusted: ask `within`.

    Attributes
    ----------
    modes : tuple of str
    box : Box
        Where the polynomials were fitted.
    coefficients : (m, d + 1, d + 1) float
        Of ``T_i(u) T_j(v)`` in cents, u and v being ln E_L and ln G_LT scaled to -1 … 1 over the
        box; zero where i + j > d.
    cells : Cells, optional
        Where in the box the polynomials follow their modes; without, everywhere.

    Raises
    ------
    ValueError
        For cells of another number of modes or lines.
    """

    modes: tuple[str, ...]
    box: Box
    coefficients: Array
    cells: Cells | None = None

    def __post_init__(self) -> None:
        if self.cells is None:
            return
        count = len(self.cells.nodes) - 1
        expected, found = (len(self.modes), count, count), self.cells.followed.shape
        if found != expected:
            raise ValueError(f"cells of shape {found}; {len(self.modes)} modes need {expected}")

    @property
    def degree(self) -> int:
        """Total degree d."""
        return int(self.coefficients.shape[1]) - 1

    def within(self, E_L_pa: Array, G_LT_pa: Array) -> NDArray[np.bool_]:
        """Whether moduli lie where the polynomials were fitted; shapes that broadcast."""
        return self.box.within(E_L_pa, G_LT_pa)

    def follows(self, E_L_pa: Array, G_LT_pa: Array) -> NDArray[np.bool_]:
        """Whether each polynomial is that of a mode with moduli (..., m), and not half another's.

        Beyond the box as at its nearest edge.
        """
        if self.cells is None:
            return np.ones(np.broadcast_shapes(np.shape(E_L_pa), np.shape(G_LT_pa)), dtype=bool)
        i, j = (
            np.clip(np.searchsorted(self.cells.nodes, unit) - 1, 0, len(self.cells.nodes) - 2)
            for unit in self.box.unit(E_L_pa, G_LT_pa)
        )
        return np.asarray(self.cells.followed[np.arange(len(self.modes)), i, j])

    def evaluate(self, E_L_pa: Array, G_LT_pa: Array) -> tuple[Array, Array, Array]:
        """See `Metamodel.evaluate`; fastest where all reeds of a mode lie side by side in memory.

        That is, for moduli (n, m) which are the transpose of an array (m, n).
        """
        count = len(self.modes)
        shape = np.broadcast_shapes(np.shape(E_L_pa), np.shape(G_LT_pa), (count,))
        E, G = (
            np.moveaxis(np.broadcast_to(modulus, shape), -1, 0).reshape(count, -1)
            for modulus in (E_L_pa, G_LT_pa)
        )
        results = tuple(np.empty(E.shape) for _ in range(3))
        for start in range(0, E.shape[1], _BLOCK):
            block = np.s_[:, start : start + _BLOCK]
            self._evaluate_block(E[block], G[block], *(result[block] for result in results))
        cents, by_E, by_G = (
            np.moveaxis(result.reshape(count, *shape[:-1]), 0, -1) for result in results
        )
        return cents, by_E, by_G

    @cached_property
    def _powers(self) -> Array:
        """Coefficients (d + 1, d + 1, m, 1) of the powers of u and v.

        On -1 … 1 and with degrees of this order they serve as well as Chebyshev's polynomials,
        and Horner's scheme needs a third of the operations of Clenshaw's.
        """
        size = self.degree + 1
        to_powers = np.zeros((size, size))
        for i, unit in enumerate(np.eye(size)):
            to_powers[i, : i + 1] = chebyshev.cheb2poly(unit)[: i + 1]
        powers = np.einsum("mij,ik,jl->klm", self.coefficients, to_powers, to_powers)
        return np.ascontiguousarray(powers[..., None])

    def _evaluate_block(self, E: Array, G: Array, cents: Array, by_E: Array, by_G: Array) -> None:
        """Horner's scheme in u over polynomials in v, values and slopes together; (m, n) each."""
        u, v = self.box.unit(E, G)
        row, row_slope = np.empty_like(u), np.empty_like(u)
        cents[...], by_E[...], by_G[...] = self._powers[self.degree, 0], 0.0, 0.0
        for i in reversed(range(self.degree)):
            _horner(self._powers[i, : self.degree - i + 1], v, row, row_slope)
            _multiply_add(by_E, u, cents)
            _multiply_add(cents, u, row)
            _multiply_add(by_G, u, row_slope)
        by_E *= 2 / np.log(self.box.E_L_pa[1] / self.box.E_L_pa[0])
        by_G *= 2 / np.log(self.box.G_LT_pa[1] / self.box.G_LT_pa[0])


def _horner(coefficients: Array, x: Array, value: Array, slope: Array) -> None:
    """Polynomial of degree 1 or more at x and its slope, into `value` and `slope`."""
    *lower, last, highest = coefficients
    np.multiply(x, highest, out=value)
    value += last
    slope[...] = highest
    for coefficient in reversed(lower):
        _multiply_add(slope, x, value)
        _multiply_add(value, x, coefficient)


def _multiply_add(accumulated: Array, factor: Array, term: Array) -> None:
    np.multiply(accumulated, factor, out=accumulated)
    np.add(accumulated, term, out=accumulated)


def fit_log_polynomial(
    modes: tuple[str, ...],
    E_L_pa: Array,
    G_LT_pa: Array,
    cents: Array,
    degree: int,
    box: Box = REED_BOX,
) -> LogPolynomial:
    """Fit polynomials to computed modes by least squares.

    Parameters
    ----------
    E_L_pa, G_LT_pa : (n,) float
        Network of materials within the box.
    cents : (n, m) float
        Above F6; NaN where a mode is not to be followed.
    degree : int
        Total degree, at least 1.

    Raises
    ------
    ValueError
        If a material lies outside the box, the degree is no degree, or what is known of a mode
        does not fix its polynomial.
    """
    if degree < 1:
        raise ValueError(f"degree {degree} follows no slope; give at least 1")
    outside = ~box.within(E_L_pa, G_LT_pa)
    if outside.any():
        E, G = E_L_pa[outside][0], G_LT_pa[outside][0]
        raise ValueError(
            f"{outside.sum()} materials such as E_L = {E:g} Pa, G_LT = {G:g} Pa lie outside "
            f"{box}; widen the box, or see whether the moduli are in Pa"
        )
    orders = [(i, j) for i in range(degree + 1) for j in range(degree + 1 - i)]
    i, j = np.transpose(orders)
    terms = chebyshev.chebvander2d(*box.unit(E_L_pa, G_LT_pa), (degree, degree))
    terms = terms[:, i * (degree + 1) + j]
    coefficients = np.zeros((len(modes), degree + 1, degree + 1))
    for m, name in enumerate(modes):
        known = ~np.isnan(cents[:, m])
        solution, _, rank, _ = np.linalg.lstsq(terms[known], cents[known, m], rcond=None)
        if rank < len(orders):
            raise ValueError(
                f"{known.sum()} materials fix {rank} of the {len(orders)} coefficients of {name}; "
                "compute more of them, spread over the box, or take a lower degree"
            )
        coefficients[m, i, j] = solution
    return LogPolynomial(modes, box, coefficients)


def network_pa(box: Box, count: int) -> tuple[Array, Array]:
    """E_L and G_LT, (count²,) each: Chebyshev's nodes of the logarithms over a box."""
    nodes = chebyshev.chebpts1(count)
    E, G = (
        np.exp(0.5 * (np.log(high) + np.log(low) + nodes * np.log(high / low)))
        for low, high in (box.E_L_pa, box.G_LT_pa)
    )
    E, G = np.meshgrid(E, G, indexing="ij")
    return E.ravel(), G.ravel()


def finite_element_polynomial(
    reed: ReducedReed,
    modes: tuple[str, ...] = PAPER_MODES,
    degree: int = 5,
    box: Box = REED_BOX,
    count: int = 24,
    least_similarity: float = 0.95,
    air_fraction: float = 1.0,
) -> LogPolynomial:
    """Follow the modes of a reed by name, straight through their crossings with others.

    Parameters
    ----------
    count : int
        Materials per modulus at which the modes are computed.
    least_similarity : float
        Materials that give a mode less of its similarity, relative to the mode at its purest, are
        left out: the bend of a crossing would be spread over the whole box.
    air_fraction : float
        Density of the air as a fraction of normal air; 0 is a vacuum.

    Raises
    ------
    ValueError
        See `fit_log_polynomial`.
    """
    E, G = network_pa(box, count)
    table, similarity = _tabulate(reed, modes, E, G, air_fraction)
    purest = np.percentile(similarity, 90, axis=0)
    cents = np.where(similarity < least_similarity * purest, np.nan, table)
    while True:
        polynomial = fit_log_polynomial(modes, E, G, cents, degree, box)
        found = polynomial.evaluate(E[:, None], G[:, None])[0]
        other_branch = np.abs(found - cents) > _OTHER_BRANCH_CENTS
        if not other_branch.any():
            break
        cents[other_branch] = np.nan
    # Where a mode is missing nothing follows it: comparisons with NaN are false.
    return replace(polynomial, cells=_cells(np.abs(found - table) < _FAITHFUL_CENTS, count))


def _cells(followed: NDArray[np.bool_], count: int) -> Cells:
    """Cells all of whose corners (count², m) are followed."""
    corners = np.moveaxis(followed.reshape(count, count, -1), -1, 0)
    inside = corners[:, :-1, :-1] & corners[:, 1:, :-1] & corners[:, :-1, 1:] & corners[:, 1:, 1:]
    return Cells(chebyshev.chebpts1(count), inside)


def _tabulate(
    reed: ReducedReed,
    modes: tuple[str, ...],
    E_L_pa: Array,
    G_LT_pa: Array,
    air_fraction: float,
) -> tuple[Array, Array]:
    """Cents above F6, NaN where a mode is missing, and similarity, (n, m) each."""
    cents = np.full((len(E_L_pa), len(modes)), np.nan)
    similarity = np.zeros_like(cents)
    for n, (E, G) in enumerate(zip(E_L_pa, G_LT_pa, strict=True)):
        found = elastic_modes(reed, float(E), float(G), air_fraction)
        for m, name in enumerate(modes):
            if name in found:
                cents[n, m] = 1200 * np.log2(found[name].frequency_hz / REFERENCE_HZ)
                similarity[n, m] = found[name].similarity
    return cents, similarity
