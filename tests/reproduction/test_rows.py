"""Rows: differences, tolerances, agreements, and what JSON says of them."""

import json

import numpy as np
import pytest

from reproduction.rows import (
    Agreement,
    Basis,
    Group,
    from_populations,
    from_text,
    interval_from_populations,
    interval_from_text,
    not_printed,
    not_reproducible,
)


@pytest.mark.parametrize(
    ("ours", "refuted", "agreement"),
    [
        (10.5, False, Agreement.REPRODUCED),
        (9.5, True, Agreement.REPRODUCED),
        (10.51, False, Agreement.DIFFERS),
        (9.4, True, Agreement.REFUTED),
    ],
)
def test_a_difference_within_tolerance_is_reproduced(ours, refuted, agreement):
    row = from_text("Table 1", "x", 10, ours, 0.5, "Hz", refuted=refuted)
    assert row.agreement is agreement
    assert row.difference == pytest.approx(ours - 10)
    assert row.basis is Basis.TEXT


def test_rounding_does_not_push_a_number_out():
    assert from_text("T", "x", 0.1, 0.1 + 0.2, 0.2).agreement is Agreement.REPRODUCED
    assert from_text("T", "x", 5, 5, 0).agreement is Agreement.REPRODUCED


def test_intervals_are_in_cents():
    row = interval_from_text("T", "x", 1000, 2000, 1200)
    assert row.difference == pytest.approx(1200)
    assert (row.unit, row.difference_unit) == ("Hz", "cents")
    assert row.agreement is Agreement.REPRODUCED
    assert interval_from_text("T", "x", 2000, 1000, 1199).agreement is Agreement.DIFFERS


def test_populations_give_mean_spread_and_a_wider_tolerance():
    values = [1.0, 3.0, 5.0]
    row = from_populations("T", "x", 6.9, values, 0.1)
    assert (row.ours, row.spread, row.tolerance) == pytest.approx((3.0, 2.0, 4.0))
    assert row.agreement is Agreement.REPRODUCED
    assert row.basis is Basis.POPULATION
    assert from_populations("T", "x", 7.1, values, 0.1).agreement is Agreement.DIFFERS
    assert from_populations("T", "x", 7.1, values, 5.0).tolerance == 5.0


def test_intervals_of_populations_have_their_spread_in_cents():
    values_hz = 1000 * 2 ** (np.array([10.0, 30.0]) / 1200)
    row = interval_from_populations("T", "x", 1000, values_hz, 5)
    assert row.difference == pytest.approx(20)
    assert row.spread == pytest.approx(np.std([10, 30], ddof=1))
    assert row.ours == pytest.approx(1000 * 2 ** (20 / 1200))
    assert row.tolerance == pytest.approx(2 * row.spread)


def test_what_is_missing_says_so():
    assert not_printed("T", "x", 3).agreement is Agreement.NOT_PRINTED
    row = not_reproducible("T", "x", 3, "Hz", "not in the text")
    assert row.agreement is Agreement.NOT_REPRODUCIBLE
    assert row.basis is Basis.NONE
    assert row.remark == "not in the text"


def test_json_has_stable_keys_and_plain_numbers():
    rows = (
        from_text("T", "a", np.float64(1), np.float32(2), 0.5, "Hz", "why"),
        from_populations("T", "b", 1, np.array([1.0, 2.0]), 0.1),
        not_printed("T", "c", np.float64(4)),
        not_reproducible("T", "d", 5, "%", "no"),
    )
    group = Group("key", "Title", "method", rows)
    answer = json.loads(json.dumps(group.to_json(), allow_nan=False))
    assert list(answer) == ["key", "title", "method", "counts", "rows"]
    assert answer["counts"] == {
        "reproduced": 1,
        "differs": 1,
        "refuted": 0,
        "not reproducible": 1,
        "not printed": 1,
    }
    keys = "table quantity printed ours difference unit difference_unit tolerance spread basis "
    keys += "agreement remark"
    assert all(list(row) == keys.split() for row in answer["rows"])
    assert answer["rows"][0] | {"remark": ""} == {
        "table": "T", "quantity": "a", "printed": 1.0, "ours": 2.0, "difference": 1.0,
        "unit": "Hz", "difference_unit": "Hz", "tolerance": 0.5, "spread": None, "basis": "text",
        "agreement": "differs", "remark": "",
    }  # fmt: skip
    assert answer["rows"][2]["printed"] is None
    assert answer["rows"][3]["ours"] is None
