"""Air around a vibrating plate: its inertia and its radiation, by panels of constant doublets.

The reed is a flat plate without a baffle, free air on both sides. With the jump [φ] of the velocity
potential across the plate and the normal velocity iωw, ∫ N(r) [φ] dS = iωw, where
N = (1 + ikr) e^(−ikr) / (4πr³) is to be read as Hadamard's finite part. The force on the plate is
iωρ[φ]; so the mass matrix grows by A(ω) = −ρ Wᵀ N⁻¹ W, whose negative imaginary part is radiation.
The mouthpiece is left out: behind the clamp the reed does not move, and only its own plate, not the
wood behind it, turns the flow round.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
# Dry air at 20 °C and 101.3 kPa: t/mm³ and mm/s.
DENSITY, SOUND = 1.204e-12, 343.2e3


@dataclass(frozen=True)
class Panels:
    """Equal rectangular panels on a flat plate, in mm."""

    x: Array
    y: Array
    dx: float
    dy: float


def panels_of(
    half_width: Callable[[Array], Array], widest: float, length: float, across: int
) -> Panels:
    """Cover 0 < x < length, −half_width < y < half_width by panels, `across` at the widest place.

    The outermost panels end a quarter of a panel before the edge. That cancels the error of first
    order that constant panels make at an edge (`tests` compare with a strip and a disc).
    """
    d = 2 * widest / (across + 0.5)
    y = (np.arange(across) - (across - 1) / 2) * d
    x = (np.arange(round(length / d)) + 0.75) * d
    xs, ys = (each.ravel() for each in np.meshgrid(x, y, indexing="ij"))
    # Half a panel less a quarter: a panel counts if its middle lies this far inside the edge.
    inside = np.abs(ys) <= half_width(xs) - 0.25 * d
    return Panels(xs[inside], ys[inside], d, d)


def air_mass(panels: Panels, deflections: Array, omega: float) -> NDArray[np.complex128]:
    """Return the matrix A(ω) in tonnes for deflections (panels, m) of the plate."""
    kernel = _kernel(panels, omega / SOUND)
    # The plate has a mirror: even and odd jumps are apart, which takes a quarter of the time.
    left = np.flatnonzero(panels.y > 0.25 * panels.dy)
    right = _mirrored(panels)[left]
    middle = np.flatnonzero(np.abs(panels.y) < 0.25 * panels.dy)
    jump = np.zeros(deflections.shape, complex)
    for sign in (1.0, -1.0):
        rows = np.concatenate([left, middle]) if sign > 0 else left
        folded = kernel[np.ix_(rows, rows)].copy()
        folded[:, : len(left)] += sign * kernel[np.ix_(rows, right)]
        part = 0.5 * (deflections[left] + sign * deflections[right])
        wanted = np.concatenate([part, deflections[middle]]) if sign > 0 else part
        solved = np.linalg.solve(folded, wanted.astype(complex))
        jump[left] += solved[: len(left)]
        jump[right] += sign * solved[: len(left)]
        if sign > 0:
            jump[middle] = solved[len(left) :]
    area = panels.dx * panels.dy
    return np.asarray(-DENSITY * area * deflections.T @ jump)


def _mirrored(panels: Panels) -> NDArray[np.int64]:
    """Return for each panel the number of its mirror image."""
    order = np.lexsort((panels.y, panels.x.round(6)))
    mirror = np.lexsort((-panels.y, panels.x.round(6)))
    found = np.empty(len(order), np.int64)
    found[order] = mirror
    return found


def _kernel(panels: Panels, k: float) -> NDArray[np.complex128]:
    i = np.round((panels.x[:, None] - panels.x) / panels.dx).astype(int)
    j = np.round((panels.y[:, None] - panels.y) / panels.dy).astype(int)
    most_i, most_j = i.max(), j.max()
    a, b = (
        np.arange(most_i + 1)[:, None] * panels.dx,
        np.arange(most_j + 1)[None, :] * panels.dy,
    )

    def corner(sx: float, sy: float) -> Array:
        x, y = a + sx * panels.dx / 2, b + sy * panels.dy / 2
        return np.asarray(np.hypot(x, y) / (x * y))

    static = -(corner(1, 1) - corner(1, -1) - corner(-1, 1) + corner(-1, -1)) / (4 * np.pi)
    r = np.hypot(a, b)
    r[0, 0] = 1.0
    wave = ((1 + 1j * k * r) * np.exp(-1j * k * r) - 1) / (4 * np.pi * r**3) * panels.dx * panels.dy
    # On its own panel, the expansion k²/(8πr) − ik³/(12π), integrated.
    dx, dy = panels.dx, panels.dy
    inverse_r = 2 * dx * np.arcsinh(dy / dx) + 2 * dy * np.arcsinh(dx / dy)
    wave[0, 0] = k**2 * inverse_r / (8 * np.pi) - 1j * k**3 * dx * dy / (12 * np.pi)
    return np.asarray((static + wave)[np.abs(i), np.abs(j)])
