"""Measured modes planted in plausible reeds, as a modal fit would find them."""

from dataclasses import dataclass

import numpy as np
import pytest

from fitting.fringes.start_frequencies import middling_shapes
from fitting.names.measured import MeasuredModes
from fitting.names.naming import visible_coordinates
from fitting.names.prediction import predict
from physics.plausible.reeds import PlausibleReeds
from physics.reed.cane.viscoelastic import Components, Series, viscoelastic_cane
from physics.reed.mode_classification import names_of
from physics.reed.surface import on_reed

CENT = np.log(2) / 1200
# Standard errors of frequencies in cents, of coordinates of shapes, and of strengths.
ERRORS = 2.0, 3e-3, 0.05


@dataclass(frozen=True)
class PlantedReed:
    """A reed and the modes that a sweep shows of it, with noise.

    Attributes
    ----------
    names, hz : by mode
        Of all modes of the reed.
    measured : MeasuredModes
        Those that are asked for, in that order.
    """

    names: tuple
    hz: np.ndarray
    measured: MeasuredModes


@pytest.fixture(scope="session")
def reeds(reed):
    return PlausibleReeds.of(reed, Series.A)


@pytest.fixture(scope="session")
def basis(reed):
    """Shapes at points as far apart as blocks, back to the clamp."""
    x, y = np.meshgrid(np.arange(1e-3, 36e-3, 1e-3), np.arange(-6e-3, 6.1e-3, 1e-3))
    inside = on_reed(reed.geometry.outline, x, y)
    cane = viscoelastic_cane(Components(), Series.A)
    found = middling_shapes(reed, cane, x[inside], y[inside])
    return found, (x[inside], y[inside])


@pytest.fixture(scope="session")
def visible(reed, basis):
    return visible_coordinates(reed, basis[0], *basis[1])


@pytest.fixture(scope="session")
def planted(reeds, visible):
    """Return ``planted(modes, seed, **parameters)``: parameters by name, in standard deviations."""
    return planting(reeds, visible)


def planting(reeds, visible):
    """Return the same for any kind of reeds."""

    def make(modes, seed=0, **parameters):
        rng, values = np.random.default_rng(seed), np.zeros(len(reeds.names))
        values[: reeds.shifts.start] = 0.5 * rng.standard_normal(reeds.shifts.start)
        for name, value in parameters.items():
            spaced = name.replace("_", " ")
            values[reeds.names.index(spaced if spaced in reeds.names else name)] = value
        here = predict(reeds, visible, values)
        _, mixing = here.nearby.modes(values)
        names = tuple(n.name for n in names_of(here.nearby.descriptors(mixing)))
        own = [m if isinstance(m, int) else names.index(m) for m in modes]
        error, noise, loud = ERRORS
        size, count = here.shape.shape[1], len(own)
        shape = here.shape[own] + noise * rng.standard_normal((count, size))
        measured = MeasuredModes(
            index=np.arange(count),
            ln_hz=here.ln_hz[own] + CENT * error * rng.standard_normal(count),
            error=np.full(count, CENT * error),
            shape=shape / np.linalg.norm(shape, axis=1, keepdims=True),
            directions=np.tile(np.eye(size), (count, 1, 1)),
            variance=np.full((count, size), noise**2),
            ln_strength=2 * here.ln_size[own] + loud * rng.standard_normal(count),
            strength_error=np.full(count, loud),
        )
        return PlantedReed(names, np.exp(here.ln_hz), measured)

    return make
