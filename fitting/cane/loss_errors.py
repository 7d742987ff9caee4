"""What is not known of a mode's stiffening, as an error of its loss factor.

Near a resonance a response is ``1 / (iη - (2 - γ) ln(f/f₀))``: only η/(2 - γ) is seen, where γ is
the exponent by which the stiffness of the mode grows with frequency. The fit of modes takes γ from
mean cane, and reeds of the population differ from it.
"""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from fitting.resonance import Resonance
from holography.arrays import Array
from physics.reed.cane.viscoelastic import (
    Components,
    Series,
    storage_modulus_pa,
    viscoelastic_cane,
)
from physics.reed.reduced.elastic import elastic_modes
from physics.reed.reduced.reed import ReducedReed

# Frequency of the moduli in which a mode's shares of E_L and G_LT are computed.
_SHARES_HZ = 4000.0
# Steps of central differences, in logarithms. Chosen: shares are then exact to a thousandth.
_STEP = 0.01


def with_stiffening_errors(
    resonances: Mapping[str, Resonance], reed: ReducedReed, series: Series
) -> dict[str, Resonance]:
    """Add what the population does not know of stiffening to the errors of loss factors.

    Parameters
    ----------
    resonances : mapping of Resonance
        By name; one that is not sure has a question mark. Those without a loss factor, or that a
        reed of mean cane does not have, stay.
    reed : ReducedReed
    series : Series
    """
    shares = _shares(reed, series)
    answer = {}
    for name, found in resonances.items():
        own = shares.get(name.removesuffix("?"))
        if found.loss_error is None or own is None:
            answer[name] = found
            continue
        error = stiffening_error(own, found.frequency_hz, series)
        answer[name] = replace(found, loss_error=float(np.hypot(found.loss_error, error)))
    return answer


def stiffening_error(shares: Array, hz: float, series: Series) -> float:
    """Relative standard error of a loss factor.

    Parameters
    ----------
    shares : (2,) float
        By which part of a relative change of E_L and of G_LT the stiffness of the mode changes.
    hz : float
        Frequency of the mode.
    series : Series
    """
    mean = shares @ _growth(Components(), hz, series)
    by_component = [
        0.5 * shares @ (_growth(ahead, hz, series) - _growth(behind, hz, series))
        for ahead, behind in (
            (Components(**{name: 1.0}), Components(**{name: -1.0}))
            for name in ("e1", "e2", "e3", "e4")
        )
    ]
    return float(np.linalg.norm(by_component) / (2 - mean))


def _growth(components: Components, hz: float, series: Series) -> Array:
    """Exponents (2,) by which E_L and G_LT grow with frequency."""
    cane = viscoelastic_cane(components, series)
    ahead, behind = (
        np.log([storage_modulus_pa(zener, at) for zener in (cane.young_L, cane.shear_LT)])
        for at in (hz * np.exp(_STEP), hz * np.exp(-_STEP))
    )
    return np.asarray((ahead - behind) / (2 * _STEP))


def _shares(reed: ReducedReed, series: Series) -> dict[str, Array]:
    """Parts of E_L and of G_LT in the stiffness of each mode of mean cane, by name."""
    cane = viscoelastic_cane(Components(), series)
    E, G = (float(storage_modulus_pa(z, _SHARES_HZ)) for z in (cane.young_L, cane.shear_LT))
    up, down = float(np.exp(_STEP)), float(np.exp(-_STEP))
    each = [elastic_modes(reed, E * e, G * g) for e, g in ((up, 1), (down, 1), (1, up), (1, down))]
    names = set.intersection(*(set(modes) for modes in each))
    logs = {n: 2 * np.log([modes[n].frequency_hz for modes in each]) for n in names}
    return {n: np.array([at[0] - at[1], at[2] - at[3]]) / (2 * _STEP) for n, at in logs.items()}
