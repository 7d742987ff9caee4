"""Rows of the comparison: a printed number, our number, and whether they agree."""

from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import ArrayLike


class Basis(StrEnum):
    """What our number stands on."""

    TEXT = "text"
    POPULATION = "population"
    NONE = "none"


class Agreement(StrEnum):
    """How a row came out."""

    REPRODUCED = "reproduced"
    DIFFERS = "differs"
    REFUTED = "refuted"
    NOT_REPRODUCIBLE = "not reproducible"
    NOT_PRINTED = "not printed"


@dataclass(frozen=True)
class Row:
    """One number.

    Attributes
    ----------
    table : str
        Where the paper has it.
    quantity : str
    printed, ours : float, optional
        Not printed literally, or not available.
    difference : float, optional
        Ours less printed, in `difference_unit`.
    unit, difference_unit : str
        Of frequencies printed in Hz the difference is in cents.
    tolerance : float
        Largest difference, of either sign, that counts as reproduced.
    basis : Basis
    remark : str
    spread : float, optional
        Of a synthetic population: standard deviation of our number from one population of as many
        reeds to the next, in `difference_unit`.
    refuted : bool
        Whether the page shows why the printed number is wrong, if it differs.
    """

    table: str
    quantity: str
    printed: float | None
    ours: float | None
    difference: float | None
    unit: str
    difference_unit: str
    tolerance: float
    basis: Basis
    remark: str = ""
    spread: float | None = None
    refuted: bool = False

    @property
    def agreement(self) -> Agreement:
        """What may be said of the printed number."""
        if self.ours is None:
            return Agreement.NOT_REPRODUCIBLE
        if self.difference is None:
            return Agreement.NOT_PRINTED
        # Rounding of a difference does not put a number at the edge of its tolerance outside.
        if abs(self.difference) <= self.tolerance * (1 + 1e-9):
            return Agreement.REPRODUCED
        return Agreement.REFUTED if self.refuted else Agreement.DIFFERS

    def to_json(self) -> dict[str, Any]:
        """Return the row with stable keys."""
        return {
            "table": self.table,
            "quantity": self.quantity,
            "printed": self.printed,
            "ours": self.ours,
            "difference": self.difference,
            "unit": self.unit,
            "difference_unit": self.difference_unit,
            "tolerance": self.tolerance,
            "spread": self.spread,
            "basis": str(self.basis),
            "agreement": str(self.agreement),
            "remark": self.remark,
        }


@dataclass(frozen=True)
class Drawing:
    """A picture of a group, drawn when a page asks for it."""

    caption: str
    draw: Callable[[], Figure]


@dataclass(frozen=True)
class Group:
    """Rows that belong together.

    Attributes
    ----------
    key : str
        Stable name.
    title : str
    method : str
        How our numbers came about, and what difference is tolerated.
    rows : tuple of Row
    drawings : tuple of Drawing
    """

    key: str
    title: str
    method: str
    rows: tuple[Row, ...]
    drawings: tuple[Drawing, ...] = ()

    def count(self, agreement: Agreement) -> int:
        """Rows with a agreement."""
        return sum(row.agreement is agreement for row in self.rows)

    def to_json(self) -> dict[str, Any]:
        """Return the group with stable keys."""
        return {
            "key": self.key,
            "title": self.title,
            "method": self.method,
            "counts": {str(agreement): self.count(agreement) for agreement in Agreement},
            "rows": [row.to_json() for row in self.rows],
        }


def from_text(
    table: str,
    quantity: str,
    printed: float,
    ours: float,
    tolerance: float,
    unit: str = "",
    remark: str = "",
    *,
    refuted: bool = False,
) -> Row:
    """Row whose number follows from the paper's text."""
    printed, ours = float(printed), float(ours)
    return Row(
        table, quantity, printed, ours, ours - printed, unit, unit, tolerance,
        Basis.TEXT, remark, refuted=refuted,
    )  # fmt: skip


def interval_from_text(
    table: str,
    quantity: str,
    printed_hz: float,
    ours_hz: float,
    tolerance_cents: float,
    remark: str = "",
    *,
    refuted: bool = False,
) -> Row:
    """Row of a frequency that follows from the text, with the interval between the two."""
    interval_cents = 1200 * float(np.log2(ours_hz / printed_hz))
    return Row(
        table, quantity, float(printed_hz), float(ours_hz), interval_cents, "Hz", "cents",
        tolerance_cents, Basis.TEXT, remark, refuted=refuted,
    )  # fmt: skip


def from_populations(
    table: str,
    quantity: str,
    printed: float,
    values: ArrayLike,
    tolerance: float,
    unit: str = "",
    remark: str = "",
) -> Row:
    """Row whose number is the mean over synthetic populations of as many reeds as the paper's.

    The paper's reeds being one population, two standard deviations from one population to the
    next are tolerated at least.
    """
    found = np.asarray(values, dtype=float)
    ours, spread = float(found.mean()), float(found.std(ddof=1))
    return Row(
        table, quantity, float(printed), ours, ours - float(printed), unit, unit,
        max(tolerance, 2 * spread), Basis.POPULATION, remark, spread,
    )  # fmt: skip


def interval_from_populations(
    table: str,
    quantity: str,
    printed_hz: float,
    values_hz: ArrayLike,
    tolerance_cents: float,
    remark: str = "",
) -> Row:
    """Row of a frequency as `from_populations`, with the interval between the two."""
    cents = 1200 * np.log2(np.asarray(values_hz, dtype=float) / printed_hz)
    interval_cents, spread = float(cents.mean()), float(cents.std(ddof=1))
    return Row(
        table, quantity, float(printed_hz), float(printed_hz * 2 ** (interval_cents / 1200)),
        interval_cents, "Hz", "cents", max(tolerance_cents, 2 * spread), Basis.POPULATION,
        remark, spread,
    )  # fmt: skip


def not_printed(table: str, quantity: str, ours: float, unit: str = "", remark: str = "") -> Row:
    """Return the row of a number that follows from the text but is not printed in it."""
    return Row(table, quantity, None, float(ours), None, unit, unit, 0.0, Basis.TEXT, remark)


def not_reproducible(table: str, quantity: str, printed: float, unit: str, reason: str) -> Row:
    """Row of a printed number that nothing in the text leads to."""
    return Row(table, quantity, float(printed), None, None, unit, unit, 0.0, Basis.NONE, reason)
