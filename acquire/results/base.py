"""What every result can do."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Any

from reports.plain_text import visible
from runs.labelled_arrays import data_frame

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes


class Result(ABC):
    """A result with a title, rows, JSON and a plot.

    ``print(result)`` shows the title. A notebook shows the rows as a table.
    """

    @property
    @abstractmethod
    def title(self) -> str:
        """One line that says what this is."""

    @abstractmethod
    def rows(self) -> list[dict[str, Any]]:
        """Return the rows of the result's table; keys name the quantity and its unit."""

    @abstractmethod
    def to_json(self) -> dict[str, Any]:
        """Return plain values with the keys that ``docs`` list for the command's ``--json``."""

    @abstractmethod
    def plot(self, ax: Axes | None = None) -> Axes:
        """Draw the result.

        Parameters
        ----------
        ax : matplotlib axes, optional
            Axes to draw on; by default, those of a new figure.

        Returns
        -------
        matplotlib axes
        """

    def to_dataframe(self) -> pd.DataFrame:
        """Return the rows as a pandas data frame.

        Raises
        ------
        MissingLibraryError
            If pandas is not installed.
        """
        return data_frame(self.rows())

    def __repr__(self) -> str:
        # A terminal must not obey characters in the name of a reed.
        return f"<{type(self).__name__}: {visible(self.title)}>"

    def _repr_html_(self) -> str:
        # Imported here, so that a plan on the command line does not wait for the page templates.
        from reports.pages import table_html
        from reports.tables import records_table

        return table_html(records_table(self.title, self.rows()))


def label_axes(axes: Axes, title: str, x: str, y: str = "") -> None:
    """Write title and labels. A name may hold what matplotlib takes for mathematics."""
    axes.set_title(visible(title), parse_math=False)
    axes.set(xlabel=x, ylabel=y)


def new_axes(ax: Axes | None) -> Axes:
    """Return the axes given, or those of a new figure that belongs to no window."""
    if ax is not None:
        return ax
    from matplotlib.figure import Figure

    return Figure(figsize=(8, 4.5), layout="constrained").add_subplot()
