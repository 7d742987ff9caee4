"""Probabilities on benches that are drawn as the priors say."""

from itertools import pairwise

import numpy as np
import pytest

from diagnosis.inference.model_selection import select_model
from diagnosis.inference.probabilities import NONE, PRIOR, UNKNOWN
from tests.diagnosis.toy import EFFECTS, bench, measured

# Strengths from a hundredth of the largest on, equally likely on a scale of logarithms.
DECADES = np.log(100)
CLASSES = {count: PRIOR[name] for count, name in enumerate(("none", "one", "two"))}
BINS = (0.0, 0.01, 0.05, 0.2, 0.5, 0.8, 0.95, 1.0)


def drawn(rng: np.random.Generator):
    """Draw what is wrong, and measure it; return the names of what does something."""
    share = np.array(list(CLASSES.values()))
    chosen = rng.choice(len(EFFECTS), rng.choice(3, p=share / share.sum()), replace=False)
    truth, names = bench(fade_per_h=2 * rng.standard_normal()), set()
    for effect in (EFFECTS[k] for k in chosen):
        (size,) = effect.parameters
        sign = 1 if size.positive else rng.choice([-1, 1])
        truth = effect.change(truth, {"size": sign * size.most * np.exp(-rng.uniform(0, DECADES))})
        names |= {effect.id} - {"nothing"}
    return names or {NONE}, measured(int(rng.integers(2**31)), truth)


@pytest.mark.slow
def test_what_is_said_to_be_likely_is_true_as_often() -> None:
    """Among what is known: something unknown is not drawn, and has little of the probability."""
    rng, said, true, unknown = np.random.default_rng(1), [], [], []
    for _ in range(250):
        names, problem = drawn(rng)
        found = select_model(problem, EFFECTS).probability
        unknown.append(found.pop(UNKNOWN))
        # What moves no number counts as none.
        found[NONE] += found.pop("nothing")
        for name, probability in found.items():
            said.append(min(probability / sum(found.values()), 1.0))
            true.append(set(name.split("+")) == names)
    said, true = np.array(said), np.array(true)
    for low, high in pairwise(BINS):
        own = (said > low) & (said <= high)
        expected, spread = said[own].sum(), np.sqrt(np.sum(said[own] * (1 - said[own])))
        assert true[own].sum() == pytest.approx(expected, abs=3 * spread + 1), (low, high)
    assert np.mean(unknown) < PRIOR["unknown"]
    assert np.max(unknown) < 0.9
