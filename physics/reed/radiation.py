"""Air that moves along with a reed, and sound that it sends out: what a vacuum lacks.

The reed is taken as a thin plate in free air, which flows round its edges. Across a plate that
moves with ``w(x)·exp(iωt)`` the potential jumps by [φ], and ``N[φ] = iωw``. N is ``-(Δ + k²)`` of
``V[φ] = ∫ [φ] exp(-ikR)/(4πR) dA`` (Maue, Z. Phys. 126, 601, 1949). The air acts on the reed as the
mass ``ρ w·N⁻¹w``, whose negative imaginary part is the resistance of radiated sound over ω.

A mouthpiece is no free plate: its rails keep air from flowing round the sides, and its chamber
guides what flows. The other limit, a wide wall around the reed (Rayleigh's integral), moves up to
twice as much air; the difference is the scale of what is not known.
"""

import numpy as np
import scipy.fft
from numpy.typing import NDArray

from holography.arrays import Array, ComplexArray, Float32Array
from physics.reed.elements.fem import Symmetry
from physics.reed.geometry import Outline, half_width_m
from physics.reed.reduced.air_matrices import AirMatrices
from physics.reed.reduced.reed import ReducedReed
from physics.reed.surface import on_reed, surface_shapes

# Dry air of 20 °C and 101.3 kPa: U.S. Standard Atmosphere (1976), equations 42 and 50.
AIR_DENSITY_KG_M3 = 1.204
SOUND_M_S = 343.2
# Lines of nodes along the reed. Chosen: with 14, 20 and 28 the frequencies of modes differ by less
# than a cent, in air that lowers them by up to 40.
_LINES = 14
# Distance of the edge from the last node, over the distance of nodes. Chosen: the mass of a strip
# then is that of theory to 0.2 % from 11 lines on.
_EDGE = 0.824
# Frequencies of the matrices, from slow air to the highest modes that are named. Chosen: with twice
# as many no mode moves by more than 0.02 cents.
_HZ = np.array([1.0, 300.0, *np.linspace(1e3, 29e3, 15)])
# Cells of a reed in a wall. Chosen: fine enough for the shortest bending waves.
_CELL_M = 0.5e-3
_SIGNS = {None: 0, Symmetry.SYMMETRIC: 1, Symmetry.ANTISYMMETRIC: -1}


def air_load(reed: ReducedReed) -> AirMatrices:
    """Free air around a reed, in the coordinates in which its strips may move."""
    nodes, spacing_m = _nodes(reed.geometry.outline)
    if None not in reed.loose:
        # One half stands for both, as in all modal masses.
        nodes = nodes[nodes[:, 1] >= 0]
    x, y = ((nodes + np.array([_EDGE, 0.5])) * spacing_m).T
    masses, resistances = [], []
    for key, shapes in surface_shapes(reed, x, y, loose=True).items():
        moved = np.stack(
            [
                AIR_DENSITY_KG_M3
                * moved_along(nodes, spacing_m, shapes, 2 * np.pi * hz / SOUND_M_S, _SIGNS[key])
                for hz in _HZ.tolist()
            ]
        )
        masses.append(moved.real)
        resistances.append(-2 * np.pi * _HZ[:, None, None] * moved.imag)
    in_wall = _in_wall(reed)
    walls = [wide - free[0] for wide, free in zip(in_wall, masses, strict=True)]
    return AirMatrices(_HZ, masses, resistances, walls)


def moved_along(
    nodes: NDArray[np.intp], spacing_m: float, deflections: Array, wavenumber: float, sign: int = 0
) -> ComplexArray:
    """Complex mass (r, r) of air around a free plate, per unit of its density.

    Parameters
    ----------
    nodes : (n, 2) int
        Places of nodes on an even grid, along and across the plate.
    spacing_m : float
        Distance of neighbouring nodes.
    deflections : (n, r) float
        Of the plate there.
    wavenumber : float
        Of sound, in rad/m.
    sign : {0, 1, -1}
        If not 0, the plate is only the half ``nodes[:, 1] >= 0`` of one that moves evenly (1) or
        oddly (−1) in ``nodes[:, 1] + ½``; the mass is that of this half.
    """
    apart = np.abs(nodes[:, None] - nodes)
    mirrored = nodes[:, None, 1] + nodes[:, 1] + 1
    size = apart[..., 0].max() + 1, max(int(apart[..., 1].max()), abs(sign) * mirrored.max()) + 1
    table = _normal_velocity(size, spacing_m, wavenumber)
    N = table[apart[..., 0], apart[..., 1]]
    if sign:
        N = N + sign * table[apart[..., 0], mirrored]
    deflections = np.asarray(deflections, dtype=float)
    jump = np.linalg.solve(N, deflections.astype(complex))
    moved = spacing_m**2 * deflections.T @ jump
    return np.asarray(0.5 * (moved + moved.T))


def _nodes(outline: Outline) -> tuple[NDArray[np.intp], float]:
    """Nodes (n, 2) of a reed, along it and across it from −7 to 6, and their distance.

    The edge lies `_EDGE` from the last node, as a mean over the curved parts of the outline.
    """
    width_m = 2 * float(np.max(half_width_m(outline, np.linspace(0.0, outline.length_m, 500))))
    spacing_m = width_m / (_LINES - 1 + 2 * _EDGE)
    along = np.arange(int(outline.length_m / spacing_m - 2 * _EDGE) + 1)
    across = np.arange(_LINES) - _LINES // 2
    nodes = np.stack(np.meshgrid(along, across, indexing="ij"), axis=-1).reshape(-1, 2)
    x, y = ((nodes + np.array([_EDGE, 0.5])) * spacing_m).T
    inside = np.abs(y) <= half_width_m(outline, x) - (_EDGE - 0.5) * spacing_m
    return nodes[inside], spacing_m


def _normal_velocity(size: tuple[int, int], spacing_m: float, wavenumber: float) -> ComplexArray:
    """Operator N between nodes that lie (nx, ny) steps apart: ``-(Δ + k²)`` of their potential."""
    V = _potential((size[0] + 1, size[1] + 1), spacing_m, wavenumber)
    around = np.pad(V, ((1, 0), (1, 0)), mode="reflect")
    inner = around[1:-1, 1:-1]
    neighbours = around[:-2, 1:-1] + around[2:, 1:-1] + around[1:-1, :-2] + around[1:-1, 2:]
    return np.asarray((4 * inner - neighbours) / spacing_m**2 - wavenumber**2 * inner)


def _potential(size: tuple[int, int], spacing_m: float, wavenumber: float) -> ComplexArray:
    """Integrals of ``exp(-ikR)/(4πR)`` over the cell of a node, seen from (nx, ny) steps away."""
    x, y = np.meshgrid(*[np.arange(n) * spacing_m for n in size], indexing="ij")
    half = 0.5 * spacing_m
    # Of 1/R, which is singular, exactly; of the rest at the middle of the cell.
    at_rest = (
        _corner(x + half, y + half)
        - _corner(x + half, y - half)
        - _corner(x - half, y + half)
        + _corner(x - half, y - half)
    )
    distance = np.hypot(x, y)
    distance[0, 0] = 1.0
    waves = np.expm1(-1j * wavenumber * distance) / distance
    waves[0, 0] = -1j * wavenumber
    return np.asarray((at_rest + spacing_m**2 * waves) / (4 * np.pi))


def _corner(x: Array, y: Array) -> Array:
    """Integral of 1/R over the rectangle from the origin to (x, y)."""
    return np.asarray(x * np.arcsinh(y / np.abs(x)) + y * np.arcsinh(x / np.abs(y)))


def _in_wall(reed: ReducedReed) -> list[Array]:
    """Mass (s, s) of slow air on both sides of a reed in a wide wall, per part.

    By Rayleigh's integral: ``ρ/2π ∫ w'/R dA'`` on either side.
    """
    outline = reed.geometry.outline
    width_m = 2 * outline.side_half_width_m + _CELL_M
    shape = round(width_m / _CELL_M), round(outline.length_m / _CELL_M)
    y, x = np.meshgrid(*[(np.arange(n) + 0.5) * _CELL_M for n in shape], indexing="ij")
    y -= 0.5 * shape[0] * _CELL_M
    inside = on_reed(outline, x, y)
    surface = surface_shapes(reed, x[inside], y[inside], loose=True)
    fraction = 2.0 if None in surface else 1.0
    return [fraction * _wide_load(shapes, inside) for shapes in surface.values()]


def _wide_load(shapes: Float32Array, inside: NDArray[np.bool_]) -> Array:
    """Mass (r, r) on one side of deflections (n, r) at the cells inside (ny, nx)."""
    padded = [2 * n for n in inside.shape]
    away = [np.minimum(np.arange(n), n - np.arange(n)) for n in padded]
    table = _potential(inside.shape, _CELL_M, 0.0).real
    table = np.pad(table, ((0, 1), (0, 1)), mode="edge")
    grid = np.zeros((shapes.shape[1], *inside.shape))
    grid[:, inside] = shapes.T
    spectra = scipy.fft.rfft2(grid, padded) * scipy.fft.rfft2(table[np.ix_(*away)])
    pushed = scipy.fft.irfft2(spectra, padded)[:, : inside.shape[0], : inside.shape[1]][:, inside]
    moved = 2 * AIR_DENSITY_KG_M3 * _CELL_M**2 * (pushed @ shapes)
    return np.asarray(0.5 * (moved + moved.T))
