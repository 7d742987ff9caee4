"""How sure answers are, compared with how often they are right, as a picture."""

import io
from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from blind.scoring import (
    Case,
    Classes,
    share,
    sure_and_right,
)

_BINS = 8


def draw_reliability(cases: Sequence[Case], classes: Classes, software: str = "reedbench") -> bytes:
    """Draw a reliability plot: points on the diagonal are as often right as they are sure.

    Parameters
    ----------
    cases : sequence of Case
    classes : Classes
    software : str
        What the picture says that it was made by.

    Returns
    -------
    picture : bytes
        PNG.
    """
    sure, right = sure_and_right(cases, classes)
    order = np.argsort(sure, kind="stable")
    figure = Figure(figsize=(5.2, 4.6), layout="constrained")
    ax = figure.subplots()
    ax.plot([0, 1], [0, 1], color="0.6", linewidth=1, label="as often right as sure")
    for piece in np.array_split(order, min(_BINS, len(order))):
        hits = share(right[piece].tolist())
        at = float(np.mean(sure[piece]))
        ax.errorbar(
            at,
            hits.value,
            yerr=[[hits.value - hits.low], [hits.high - hits.value]],
            fmt="o",
            color="C0",
            capsize=3,
            label=None,
        )
    ax.set(
        xlim=(0, 1.02),
        ylim=(0, 1.02),
        xlabel="probability given to the likeliest class (1 where none was)",
        ylabel="share of cases in which it is the truth",
        title=f"sealed cases: {len(cases)}, with 95 % intervals",
    )
    ax.legend(loc="upper left", frameon=False)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=150, metadata={"Software": software})
    return buffer.getvalue()
