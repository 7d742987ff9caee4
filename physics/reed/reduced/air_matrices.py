"""What the air around a reed adds to its dynamic stiffness, in reduced coordinates."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.interpolate import CubicSpline

from holography.arrays import Array


@dataclass(frozen=True)
class AirMatrices:
    """What normal air adds, per part of a reed (see `physics.reed.radiation`).

    Attributes
    ----------
    hz : (k,) float
        Frequencies of the matrices.
    mass_kg, resistance_kg_s : list of (k, s, s) float
        Moved along, and of sound that is radiated, at these frequencies.
    wall_kg : list of (s, s) float
        Mass that a wide wall around the reed would add to that, where sound is slow to change.
    """

    hz: Array
    mass_kg: list[Array]
    resistance_kg_s: list[Array]
    wall_kg: list[Array]

    @cached_property
    def amounts(self) -> CubicSpline:
        """Weights (m, k) of the k matrices at log frequencies (m,)."""
        # Beyond the highest frequency the air stays as it is there.
        hz = np.append(self.hz, [2 * self.hz[-1], 4 * self.hz[-1]])
        weights = np.eye(len(self.hz))
        return CubicSpline(np.log(hz), np.vstack([weights, weights[-1:], weights[-1:]]))

    def forms(self, number: int, hz: Array, shapes: Array) -> Array:
        """Mass (m,) of air on the shapes (r, m) of a part of a number, each at its frequency."""
        held = slice(len(shapes))
        along = self.mass_kg[number][:, held, held] @ shapes
        moved = np.sum(along * shapes, axis=1).T
        return np.asarray(np.sum(self.amounts(np.log(hz)) * moved, axis=1))

    def resistances(self, number: int, shapes: Array) -> Array:
        """Resistance (k, m, m) between shapes (r, m) of a part of a number, at `hz`."""
        held = slice(len(shapes))
        between: Array = shapes.T @ self.resistance_kg_s[number][:, held, held] @ shapes
        return between

    def products(self, hz: float, coordinates: Array) -> Array:
        """Mass of air at a frequency times coordinates (s,) of all parts."""
        masses = [mass for mass, _ in self.at(hz)]
        each = np.split(coordinates, np.cumsum([len(mass) for mass in masses])[:-1])
        return np.concatenate([m @ own for m, own in zip(masses, each, strict=True)])

    def at(self, hz: float) -> list[tuple[Array, Array]]:
        """Mass and resistance (s, s) of each part at a frequency."""
        amounts = self.amounts(np.log(hz))
        return [
            (np.tensordot(amounts, mass, axes=1), np.tensordot(amounts, resistance, axes=1))
            for mass, resistance in zip(self.mass_kg, self.resistance_kg_s, strict=True)
        ]
