"""Some hundred changed files of each kind; `python -m benchmarks.fuzz` tries many more."""

import pytest

from benchmarks.fuzz import fuzz_text
from benchmarks.fuzzing.runs import fuzz_runs

# As many as take a few seconds.
COUNTS = {"protocol": 150, "bench": 150, "reed": 60, "campaign": 100, "table": 500}


@pytest.mark.slow
@pytest.mark.parametrize("kind", COUNTS)
def test_a_changed_file_is_read_as_a_person_reads_it_or_refused_in_one_line(kind, tmp_path):
    tally = fuzz_text(kind, COUNTS[kind], seed=20_261_122, folder=tmp_path)
    assert {what: wrong.example for what, wrong in tally.distinct.items()} == {}
    assert min(tally.accepted, tally.refused) > COUNTS[kind] // 20


@pytest.mark.slow
def test_a_changed_run_file_is_read_as_it_was_or_refused_in_one_line(tmp_path):
    tally = fuzz_runs(60, seed=20_261_122, folder=tmp_path)
    assert {what: wrong.said for what, wrong in tally.distinct.items()} == {}
    assert min(tally.accepted, tally.refused) > 5
