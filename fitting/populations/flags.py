"""Flags of fits of many reeds, and the models that they can use."""

from dataclasses import dataclass
from enum import IntFlag, auto
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from holography.arrays import Array, Mask
from physics.reed.reduction.metamodel import Metamodel


class Flag(IntFlag):
    """What is unusual about a fit. The numbers stand as they came out, whatever is flagged.

    Springs and storage moduli are looked at in the series in which the reed has resonances.
    """

    TOO_FEW_RESONANCES = auto()
    """No more resonances than components: nothing is fitted."""
    UNDETERMINED = auto()
    """The resonances do not determine all components; undetermined ones are NaN."""
    NOT_CONVERGED = auto()
    """No least squares found; the components are the best seen, their errors mean little."""
    E1_NOT_POSITIVE = auto()
    E2_NOT_POSITIVE = auto()
    G1_NOT_POSITIVE = auto()
    G2_NOT_POSITIVE = auto()
    STORAGE_MODULUS_NOT_POSITIVE = auto()
    """E' or G' is not, at the frequency of some mode, observed or not."""
    OUTSIDE_METAMODEL = auto()
    """Moduli of an observed mode lie where the metamodel was not fitted."""
    MODES_LEFT_OUT = auto()
    """Some modes exchange shapes with others at the reed's moduli; the fit is without them."""


SPRING_FLAGS = (
    (0, Flag.E1_NOT_POSITIVE),
    (1, Flag.E2_NOT_POSITIVE),
    (3, Flag.G1_NOT_POSITIVE),
    (4, Flag.G2_NOT_POSITIVE),
)


@runtime_checkable
class BoundedMetamodel(Metamodel, Protocol):
    """A metamodel with a known range of moduli."""

    def within(self, E_L_pa: Array, G_LT_pa: Array) -> Mask:
        """Return whether moduli lie in the range; the shapes broadcast."""


@runtime_checkable
class FollowingMetamodel(Metamodel, Protocol):
    """A metamodel that is valid for each mode in its own range of moduli."""

    def follows(self, E_L_pa: Array, G_LT_pa: Array) -> Mask:
        """Return whether the metamodel is valid for each mode, at moduli (..., m)."""


@dataclass(frozen=True)
class PopulationFit:
    """Fitted components of n reeds; undetermined ones are NaN with an infinite error.

    Attributes
    ----------
    components : (n, K) float
        e1, e2, e3 from series A; e4 too from both series.
    errors : (n, K) float
        Standard errors, from the stated errors of the resonances and the excess scatter.
    reduced_chi2 : (n,) float
        Weighted squares per degree of freedom of the best fit with the stated errors.
    excess_scatter_cents : (n,) float
        Excess scatter: standard deviation of the resonances around the model, in addition to the
        stated errors. It is 0 where `reduced_chi2` passes a χ² test at 5 %.
    residual_cents : (n, s, m) float
        Observed less fitted frequencies, NaN for resonances that were not used.
    rms_cents : (n,) float
        Their root mean square.
    used : (n,) int
        Number of resonances.
    left_out : (n, s, m) bool
        Resonances that were not used, because their modes exchange shapes with others.
    flags : (n,) int
        Combinations of `Flag`; 0 is an ordinary fit.
    """

    components: Array
    errors: Array
    reduced_chi2: Array
    excess_scatter_cents: Array
    residual_cents: Array
    rms_cents: Array
    used: NDArray[np.int64]
    left_out: Mask
    flags: NDArray[np.int64]


def count_flags(flags: NDArray[np.int64]) -> dict[str, int]:
    """Return the number of reeds with each flag, by its name; unused flags are omitted."""
    counts = {str(flag.name): int(np.count_nonzero(flags & int(flag))) for flag in Flag}
    return {name: count for name, count in counts.items() if count}
