"""What is kept of answers gives the scores that whole answers give."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("skfem", reason="the extra 'blind' is not installed")

from blind.cases import (
    drawn_label,
    seal,
    true_sizes,
)
from blind.classes import CLASSES
from blind.report import report
from blind.scoring import Case, Classes
from studies.sealed.answers import essence, kept_cases, main


def _answer(case_number: int, named: tuple[str, ...]) -> dict[str, Any]:
    """An answer with all that scores read, and more, of no reed."""
    rng = np.random.default_rng(case_number)
    names = sorted({name for group in CLASSES for name in group} | {"carrier", "crack", *named})
    keys = ["none", "unknown", *names, "+".join(named) or "none", "carrier+crack"]
    # Every other answer is right, so that sizes are scored too.
    weights = np.full(len(keys), 0.1)
    weights[keys.index("+".join(named) or "none")] += 9.0 * (case_number % 2)
    shares = rng.dirichlet(weights)
    probability = dict.fromkeys(keys, 0.0)
    for key, value in zip(keys, shares.tolist(), strict=True):
        probability[key] += value
    likeliest = max(probability, key=lambda key: probability[key])
    gap = {"before": 9.0 + float(rng.random()), "after": 1.0 + float(rng.random()), "cents": [1, 2]}
    return {
        "verdict": "not converged" if rng.random() < 0.2 else "effect",
        "effects_named": [] if likeliest in ("none", "unknown") else likeliest.split("+"),
        "likely": [[likeliest], ["none"]],
        "probability": probability,
        "effects": {
            name: {
                "d_prime": float(rng.uniform(0, 12)),
                "detectable": {"size": 0.123456789, "length": 1e-5},
                "sizes": {"size": {"value": 0.3333333333, "error": 0.1, "prior": [0, 1]}},
                "text": "what scores do not read",
            }
            for name in names
        },
        "explained_fraction": {
            "by": {key: dict(gap, after=gap["after"] + n) for n, key in enumerate(probability)}
        },
        "gap": list(range(1000)),
    }


@pytest.fixture
def cases() -> list[Case]:
    found = []
    for tier in (0, 1, 3, 4):
        for number in range(12):
            label = drawn_label(tier, number, 5)
            named = tuple(name for name, _ in label.effects) if label.known else ()
            answer = _answer(100 * tier + number, named)
            for name, sizes in true_sizes(label).items():
                effect = answer["effects"][name]
                effect["sizes"] = {p: {"value": 1.1 * v, "error": 0.2} for p, v in sizes.items()}
                effect["detectable"] = {p: abs(v) / 2 for p, v in sizes.items()}
            found.append(Case(f"{tier}-{number}", label, None if number == 3 else answer))
    return found


def test_scores_are_those_of_whole_answers(cases: list[Case]) -> None:
    kept = [Case(case.name, case.label, essence(case)) for case in cases]
    whole, short = (report(some, Classes(CLASSES)) for some in (cases, kept))
    assert _numbers(short) == pytest.approx(_numbers(whole), abs=1e-5, rel=1e-4)
    assert len(set(_numbers(whole).values())) > 50
    assert whole["sizes"]["sizes"] > 0
    assert len(json.dumps(kept[0].answer)) < 0.5 * len(json.dumps(cases[0].answer))


def _numbers(scores: Any, path: str = "") -> dict[str, float]:
    if isinstance(scores, dict):
        return {k: v for key in scores for k, v in _numbers(scores[key], f"{path}/{key}").items()}
    if isinstance(scores, list):
        return {
            k: v for n, own in enumerate(scores) for k, v in _numbers(own, f"{path}/{n}").items()
        }
    return {} if scores is None or isinstance(scores, str) else {path: float(scores)}


def test_what_is_printed_is_read_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    labels = [drawn_label(1, number, 7) for number in range(3)]
    sealed, key = seal(labels)
    (tmp_path / "cases").mkdir()
    (tmp_path / "cases" / "sealed.json").write_text(json.dumps(sealed), encoding="utf-8")
    (tmp_path / "key.json").write_text(json.dumps(key), encoding="utf-8")
    (tmp_path / "answers").mkdir()
    first, *_, last = sorted(key["cases"])
    answer = _answer(1, tuple(name for name, _ in labels[0].effects))
    (tmp_path / "answers" / f"{first}.json").write_text(json.dumps(answer), encoding="utf-8")
    asked = [str(tmp_path / name) for name in ("cases", "answers", "key.json")]
    monkeypatch.setattr("sys.argv", ["sealed_answers", *asked])
    main()
    printed = capsys.readouterr()
    # Missing answers are reported.
    assert last in printed.err
    assert first not in printed.err
    (tmp_path / "kept.json").write_text(printed.out, encoding="utf-8")
    named = dict(zip(sorted(key["cases"]), labels, strict=True))
    read = {case.name: case for case in kept_cases(named, [tmp_path / "kept.json"])}
    assert set(read) == set(named)
    assert read[last].answer is None
    kept = read[first].answer
    assert kept is not None
    assert kept["verdict"] == answer["verdict"]
    assert sum(kept["probability"].values()) == pytest.approx(1, abs=1e-5)
