"""Numbers that are wrong: results of fits have long tails, whatever their errors say.

A fit of a sweep may end in a wrong optimum for one mode. One number can then gain any hypothesis
that happens to move it as much as a thousand good numbers can. So each number of some groups is
wrong with a small probability, by an error that is larger by a factor. A few that are likelier
wrong than right, given a hypothesis, are taken to be wrong there, at the price of that probability.
"""

import math
from typing import Final

import numpy as np

from diagnosis.inference.linear_model import LinearModel, Weighed, weigh
from diagnosis.inference.problem import InferenceProblem

# Probability that a number is wrong, and by how many times its error. Routine data have 1 to 10 %
# of gross errors (Hampel, Ronchetti, Rousseeuw and Stahel, Robust Statistics, Wiley 1986, section
# 1.2c); the least of these. Chosen: an order of magnitude.
_WRONG: Final = 0.01
TIMES: Final = 10.0
# Most numbers that are wrong. Chosen: what moves more of them is a cause.
_MOST = 3
# Iterations of the scales after each.
_TURNS = 10


def with_gross_errors(
    problem: InferenceProblem, model: LinearModel, weighed: Weighed
) -> tuple[LinearModel, Weighed]:
    """Return a model in which numbers that are likelier wrong than right are wrong, and weigh it.

    Parameters
    ----------
    problem : InferenceProblem
    model : LinearModel
        In which no number is wrong.
    weighed : Weighed
        The same with the likeliest scales.
    """
    columns = TIMES * problem.errors_of_fits
    price = math.log(_WRONG / (1 - _WRONG))
    for _ in range(min(_MOST, columns.shape[1])):
        across = weighed.precision @ columns
        known = np.einsum("nk,nk->k", columns, across)
        pull = across.T @ model.left
        gain = 0.5 * pull**2 / (1 + known) - 0.5 * np.log1p(known) + price
        best = int(np.argmax(gain))
        if gain[best] <= 0:
            break
        model = model.with_gross_error(columns[:, best], price)
        weighed = weigh(model, weighed.scales, _TURNS)
        columns = np.delete(columns, best, axis=1)
    return model, weighed
