"""What goes wrong on a bench ends in right data or in a safe stop: the table of faults."""

import signal
from dataclasses import replace

import pytest

from benchmarks import faults
from benchmarks.faults import FAULTS, as_expected


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.name)
def test_a_fault_ends_in_right_data_or_in_a_safe_stop(fault, tmp_path):
    outcome = faults.struck(fault, tmp_path)
    assert outcome.wrong == 0
    assert as_expected(fault, outcome), outcome
    if fault.ending == "complete" and not fault.protocol:
        assert outcome.good == 10


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_in_a_safe_stop(number, tmp_path):
    outcome = faults.signalled(number, tmp_path)
    assert (outcome.ending, outcome.wrong, outcome.off) == ("stopped", 0, True)
    assert outcome.unconfirmed == ()
    assert 4 <= outcome.good < 10


def test_a_disk_that_fills_up_ends_in_a_safe_stop_and_a_readable_file(tmp_path):
    outcome = faults.full_disk(tmp_path)
    if outcome is None:
        pytest.skip("this user may not mount a small disk")
    assert (outcome.ending, outcome.wrong, outcome.off) == ("stopped", 0, True)
    assert "make room on the disk" in outcome.reason


def test_a_computers_clock_that_is_set_back_changes_nothing_but_time_stamps(tmp_path):
    outcome = faults.clock_set_back(tmp_path)
    assert (outcome.ending, outcome.good, outcome.wrong, outcome.off) == ("complete", 10, 0, True)


def test_a_run_in_work_is_left_alone(tmp_path):
    said, outcome = faults.locked(tmp_path)
    assert "locked.h5" in said
    assert (outcome.ending, outcome.good, outcome.wrong) == ("complete", 10, 0)


def test_what_is_left_of_killed_runs_is_right_and_can_be_gone_on_with(tmp_path):
    kills = faults.killed(6, tmp_path, seed=3)
    assert kills.resumed >= 2
    assert (kills.damaged, kills.wrong, kills.bad) == (0, 0, 0)


def test_a_step_that_is_not_as_planned_is_seen(tmp_path):
    """The judge of all these tests: a plan of other volts than those that were played."""
    path = tmp_path / "calm.h5"
    ended, unconfirmed, truth = faults.measured(faults.CALM, path)
    calm = faults.outcome_of(faults.CALM, path, (ended, unconfirmed, truth))
    assert (calm.good, calm.wrong) == (10, 0)
    louder = [
        (
            time_s,
            state if state.drive_v == 0 else replace(state, drive_v=1.001 * state.drive_v),
        )
        for time_s, state in truth.changes
    ]
    other = faults.Truth(louder, truth.exposed_s)
    assert faults.outcome_of(faults.CALM, path, (ended, unconfirmed, other)).wrong == 10
    early = {frame: began_s - 0.2 for frame, began_s in truth.exposed_s.items()}
    other = faults.Truth(truth.changes, early)
    assert faults.outcome_of(faults.CALM, path, (ended, unconfirmed, other)).wrong == 10
