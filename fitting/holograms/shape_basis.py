"""Mode shapes of a reed at points of its surface, and an orthogonal basis of their span."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import linalg

from holography.arrays import Array, Float32Array
from physics.effects.clamp_compliance import EFFECT as CLAMP_COMPLIANCE
from physics.reed.cane.material import constants_of, terms_and_slopes
from physics.reed.elements.fem import Symmetry
from physics.reed.reduced.changes import yielding_clamp
from physics.reed.reduced.elastic import elastic_modes, reduced_modes
from physics.reed.reduced.reed import CONSTANTS, ReducedReed, ReedPart
from physics.reed.surface import surface_shapes

# Modes above the sweep contribute their static response, and freedom for shapes that differ from
# those of the finite elements. Those of the reduced reed above this lie 0.5 to 2 semitones from the
# finite elements, so their shapes are of no real mode.
_HIGHEST_HZ = 36e3
# Shapes up to here are represented exactly; the weight of higher ones decreases with frequency.
_EXACT_HZ = 22e3
# Functions with a singular value below this fraction of the first are left out: half a per cent of
# the largest shape. A clarinet reed then has 32, larger reeds some 40. Chosen: the most, which
# bounds the time of a fit.
_LEAST_FRACTION, _MOST_FUNCTIONS = 5e-3, 48
# Stiffnesses of shear among the nine of `physics.reed.cane.material`.
_SHEAR = slice(6, 9)
# Usual compliance of the clamp, in m per Pa.
_COMPLIANCE_M_PA = CLAMP_COMPLIANCE.parameters[0].spread


@dataclass(frozen=True)
class ShapeBasis:
    """Mode shapes of a reed at points of its surface, in coordinates of few functions.

    Attributes
    ----------
    functions : (n, j) float32
        Orthogonal functions, mean square 1 over the points.
    shapes : (m, j) float
        Coordinates of the shapes of all modes, each with a largest deflection of 1 at the points.
    names : tuple of str
        Names of the modes; symmetry and number where a mode has no name.
    hz : (m,) float
        Eigenfrequencies in this cane, ascending.
    stiffening : (m,) float
        Exponent of the growth of a mode's stiffness with frequency near its resonance.
    shares : (2, m, m) float
        G of `fitting.modal.losses` between modes of unit elastic energy, of shear and of the
        clamp.
    sound_hz : (h,) float
        Frequencies of `sound`.
    sound : (h, m, m) float
        Resistance of the sound that a mode sends to another one, in 1/s, for modes of unit mass.
    largest : (m,) float
        Largest deflection of modes of unit mass at the points.
    coordinates : mapping of (r, j) float
        Reduced coordinates of the functions in each part of the reed.
    """

    functions: Float32Array
    shapes: Array
    names: tuple[str, ...]
    hz: Array
    stiffening: Array
    shares: Array
    sound_hz: Array
    sound: Array
    largest: Array
    coordinates: Mapping[Symmetry | None, Array]

    def at(self, reed: ReducedReed, x_m: Array, y_m: Array) -> "ShapeBasis":
        """Return the same functions at other points (n,) of the reed.

        Whatever has coordinates in the functions keeps them. The functions are orthogonal at the
        points for which they were computed, and nearly so at others that cover the same area.
        """
        surface = surface_shapes(reed, x_m, y_m)
        parts = [surface[part] @ own for part, own in self.coordinates.items()]
        return replace(self, functions=np.sum(parts, axis=0).astype(np.float32))

    def stiffening_of(self, names: Sequence[str]) -> Array:
        """Return the exponents (a,) of modes of these names."""
        return self.stiffening[[self.names.index(name) for name in names]]


def shape_basis(
    reed: ReducedReed,
    E_L_pa: float,
    G_LT_pa: float,
    x_m: Array,
    y_m: Array,
    growth: Callable[[float], tuple[float, float]] | None = None,
) -> ShapeBasis:
    """Compute the mode shapes of a reed for fixed moduli, including modes of its heel and sides.

    Parameters
    ----------
    reed : ReducedReed
    E_L_pa, G_LT_pa : float
        Moduli in the middle of the sweep; shapes depend little on them.
    x_m, y_m : (n,) float
        Points on the bark side.
    growth : callable, optional
        Returns the exponents with which E_L and G_LT grow with frequency, at a frequency in Hz.
    """
    constants = constants_of([replace(reed.cane, E_L_pa=E_L_pa, G_LT_pa=G_LT_pa)])
    (terms,), (slopes,) = terms_and_slopes(constants)
    by_moduli = slopes[:, [CONSTANTS.index("E_L_pa"), CONSTANTS.index("G_LT_pa")]]
    surface, named = surface_shapes(reed, x_m, y_m), _named(reed, E_L_pa, G_LT_pa)
    found: list[tuple[float, str, float]] = []
    shares, shapes, taken_by_clamp = [], [], _yielding(reed)
    for symmetry, half in reed.parts.items():
        hz, vectors = reduced_modes(half, terms, reed.cane.density_kg_m3)
        below = int(np.count_nonzero(hz < _HIGHEST_HZ))
        hz, vectors = hz[:below], vectors[:, :below]
        stiffens = _stiffening(half, terms, by_moduli, hz, vectors, growth)
        lossy = _shear(half, terms, vectors), taken_by_clamp(symmetry, terms, hz, vectors)
        shares.append([each / (2 * np.pi) ** 2 / np.outer(hz, hz) for each in lossy])
        shapes.append(vectors)
        for number, own_hz in enumerate(hz.tolist()):
            name = named.get((symmetry, round(own_hz, 3)), _unnamed(symmetry, number))
            found.append((own_hz, name, float(stiffens[number])))
    order = np.argsort([mode[0] for mode in found])
    frequencies, names, stiffening = zip(*(found[m] for m in order), strict=True)
    coordinates = linalg.block_diag(*shapes)[:, order]
    deflection = np.hstack([surface[part] for part in reed.parts]) @ coordinates
    largest = np.abs(deflection).max(axis=0)
    deflection = deflection / largest
    among = np.ix_(order, order)
    whole = [linalg.block_diag(*each)[among] for each in zip(*shares, strict=True)]
    sound_hz, sound = _sound(reed, shapes)
    functions, mixing = _functions(deflection, np.array(frequencies))
    parts = np.split(coordinates / largest @ mixing, np.cumsum([len(v) for v in shapes])[:-1])
    return ShapeBasis(
        functions.astype(np.float32),
        (functions.T @ deflection / len(functions)).T,
        names,
        np.array(frequencies),
        np.array(stiffening),
        np.stack(whole),
        sound_hz,
        sound[:, among[0], among[1]],
        largest,
        dict(zip(reed.parts, parts, strict=True)),
    )


def _stiffening(
    half: ReedPart,
    terms: Array,
    by_moduli: Array,
    hz: Array,
    vectors: Array,
    growth: Callable[[float], tuple[float, float]] | None,
) -> Array:
    """Return the exponents (m,) with which the stiffness of modes grows; 0 without `growth`."""
    if growth is None:
        return np.zeros(len(hz))
    energies = np.einsum("im,tij,jm->mt", vectors, half.stiffness_terms, vectors, optimize=True)
    felt = energies @ by_moduli / (energies @ terms)[:, None]
    exponents = np.array([growth(each) for each in hz.tolist()])
    return np.asarray(np.sum(felt * exponents, axis=1))


def _named(
    reed: ReducedReed, E_L_pa: float, G_LT_pa: float
) -> dict[tuple[Symmetry | None, float], str]:
    """Return the names of modes by their part of the reed and their frequency."""
    modes = elastic_modes(reed, E_L_pa, G_LT_pa, air_fraction=0.0)
    return {(mode.part, round(mode.frequency_hz, 3)): name for name, mode in modes.items()}


def _sound(reed: ReducedReed, shapes: Sequence[Array]) -> tuple[Array, Array]:
    """Return the resistance (h, m, m) between mass-normalised shapes, and its frequencies (h,)."""
    if reed.air is None:
        size = sum(each.shape[1] for each in shapes)
        return np.array([1.0, _HIGHEST_HZ]), np.zeros((2, size, size))
    parts = [reed.air.resistances(part, each) for part, each in enumerate(shapes)]
    whole = [linalg.block_diag(*at) for at in zip(*parts, strict=True)]
    return reed.air.hz, np.stack(whole)


def _shear(half: ReedPart, terms: Array, vectors: Array) -> Array:
    """Return the part (m, m) of the stiffness of mass-normalised shapes that belongs to shear."""
    shear = np.tensordot(terms[_SHEAR], half.stiffness_terms[_SHEAR], axes=1)
    found: Array = vectors.T @ shear @ vectors
    return found


def _yielding(reed: ReducedReed) -> Callable[[Symmetry | None, Array, Array, Array], Array]:
    """Return a function for the stiffness (m, m) that a yielding clamp takes from shapes."""
    yields_m_n = np.asarray(yielding_clamp(reed, 1.0, 1.0).compliance_m_n) * _COMPLIANCE_M_PA
    each = len(reed.strip) // len(reed.loose)
    rows = {key: slice(each * k, each * (k + 1)) for k, key in enumerate(reed.loose)}

    def taken(key: Symmetry | None, terms: Array, hz: Array, vectors: Array) -> Array:
        part = reed.loose[key]
        strip = slice(part.held, part.size)
        held = np.zeros((part.size, vectors.shape[1]))
        held[: part.held] = vectors
        squares = (2 * np.pi * hz) ** 2
        elastic = np.tensordot(terms, part.stiffness_terms[:, strip], axes=1) @ held
        force = reed.cane.density_kg_m3 * (part.mass[strip] @ held) * squares - elastic
        return np.asarray(force.T @ yields_m_n[rows[key], rows[key]] @ force)

    return taken


def _unnamed(symmetry: Symmetry | None, number: int) -> str:
    return f"{symmetry or 'mode'} {number + 1}"


def _functions(deflection: Array, hz: Array) -> tuple[Array, Array]:
    """Return orthogonal functions (n, j) of mean square 1 that span shapes (n, m).

    With them come the weights (m, j) with which shapes add up to them.
    """
    weight = np.minimum(1.0, (_EXACT_HZ / hz) ** 2)
    left, values, right = np.linalg.svd(deflection * weight, full_matrices=False)
    size = min(int(np.count_nonzero(values > _LEAST_FRACTION * values[0])), _MOST_FUNCTIONS)
    unit = np.sqrt(len(deflection))
    return left[:, :size] * unit, weight[:, None] * right[:size].T / values[:size] * unit
