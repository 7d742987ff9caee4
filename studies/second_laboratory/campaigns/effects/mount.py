"""Clamp, cracks, large motion, and the air around the reed."""

from dataclasses import dataclass, replace

from studies.second_laboratory.campaigns.effects.base import (
    Body,
    ComplexArray,
    Effect,
    Moment,
    place,
    size,
)
from studies.second_laboratory.parameters import Crack, ReedParameters

_SOFT = "0.05 mm of paper to 0.5 mm of cork under the strips, E = 20–200 MPa (chosen)"


@dataclass(frozen=True)
class ClampCompliance(Effect):
    """The clamp gives: a soft layer lies under both strips, in series with their bed."""

    id = "clamp_compliance"
    mm3_per_n: float = size(3e-5, 1e-2, "mm³/N", "compliance of the layer per area", _SOFT)

    def reed(self, reed: ReedParameters) -> ReedParameters:
        """Soften the bed."""
        if not self.mm3_per_n:
            return reed
        stiff = reed.clamp.bed_n_per_mm3
        bed = 1 / (self.mm3_per_n + (1 / stiff if stiff else 0.0))
        return replace(reed, clamp=replace(reed.clamp, bed_n_per_mm3=bed))


@dataclass(frozen=True)
class ClampAsymmetry(Effect):
    """A soft layer lies under one of the strips only."""

    id = "clamp_asymmetry"
    mm3_per_n: float = size(6e-5, 2e-2, "mm³/N", "compliance of the layer per area", _SOFT)
    side: float = place(-1.0, 1.0, "", "the left strip if positive, else the right one")

    def reed(self, reed: ReedParameters) -> ReedParameters:
        """Soften the bed of one strip."""
        stiff = reed.clamp.bed_n_per_mm3
        if not (self.mm3_per_n and stiff):
            return reed
        left, right = reed.clamp.sides
        share = 1 / (1 + self.mm3_per_n * stiff)
        sides = (left * share, right) if self.side > 0 else (left, right * share)
        return replace(reed, clamp=replace(reed.clamp, sides=sides))


@dataclass(frozen=True)
class ShortCrack(Effect):
    """A short crack along the grain, or one that goes through a part of the thickness."""

    id = "crack"
    lost: float = size(
        0.05,
        0.97,
        "",
        "stiffness across the grain that is lost over 0.8 mm",
        "shallow checks to splits of played reeds (chosen)",
    )
    length_mm: float = place(2.0, 12.0, "mm", "its length")
    x_mm: float = place(0.5, 18.0, "mm", "its end on the side of the tip")
    y_mm: float = place(-5.0, 5.0, "mm", "its place across the reed")

    def reed(self, reed: ReedParameters) -> ReedParameters:
        """Add a crack."""
        if not self.lost:
            return reed
        crack = Crack(self.x_mm, self.y_mm, self.length_mm, 0.8, self.lost)
        return replace(reed, flaws=replace(reed.flaws, crack=crack))


@dataclass(frozen=True)
class HardeningNonlinearity(Effect):
    """Stiffness along the grain grows with the square of the amplitude.

    Slopes of a plate stretch it, and the edge of the table takes part of its span when it bends
    far; both act through the curvature along the grain.
    """

    id = "hardening_nonlinearity"
    nonlinear = True
    per_um2: float = size(
        0.002,
        0.08,
        "per µm²",
        "growth of the stiffness along the grain, by the square of the peak amplitude",
        "contact at the edge of the table; von Kármán's stretching alone gives 1e-4 (chosen)",
    )

    def dynamic(self, matrix: ComplexArray, body: Body, now: Moment) -> ComplexArray:
        """Stiffen the reed by its amplitude."""
        return matrix + self.per_um2 * body.peak_um() ** 2 * body.along()


@dataclass(frozen=True)
class AirLoad(Effect):
    """More air moves along with the reed than with a plate in free air: walls are near."""

    id = "air_load"
    more: float = size(
        0.04,
        1.0,
        "relative",
        "air that moves along in addition",
        "walls near a body up to double its added mass (Brennen 1982, NCEL report CR 82.010)",
    )

    def reed(self, reed: ReedParameters) -> ReedParameters:
        """Raise the inertia of the air, not its radiation."""
        inertia = reed.flaws.air_inertia * (1 + self.more)
        return replace(reed, flaws=replace(reed.flaws, air_inertia=inertia))
