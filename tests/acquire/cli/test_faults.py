"""What goes wrong on a bench ends in right data or in a safe stop: the table of faults."""

import signal
from dataclasses import replace

import pytest

from benchmarks.striking import fault_openings, fault_processes, struck
from benchmarks.striking.fault_list import FAULTS, NO_FAULT
from benchmarks.striking.fault_openings import OPENINGS


def marked(fault):
    """Return a parameter of a test, slow if every reply of an instrument is late."""
    marks = [pytest.mark.slow] if "every reply" in fault.name else []
    return pytest.param(fault, id=fault.name, marks=marks)


@pytest.mark.parametrize("fault", [marked(fault) for fault in FAULTS])
def test_a_fault_ends_in_right_data_or_in_a_safe_stop(fault, tmp_path):
    outcome = struck.struck(fault, tmp_path)
    assert outcome.wrong == 0
    assert struck.as_expected(fault, outcome), outcome


@pytest.mark.parametrize("opening", OPENINGS, ids=lambda opening: opening.name)
def test_a_bench_that_cannot_be_opened_is_off_as_far_as_it_can_be_reached(opening):
    found = fault_openings.opened(opening)
    assert fault_openings.as_expected(opening, found), found


def test_a_bench_that_another_program_uses_is_left_alone():
    found = fault_openings.in_use()
    assert "is in use by process" in found.message
    assert (found.tweeter_on, found.rf_on) == (True, True)


@pytest.mark.parametrize(
    ("number", "phase", "ending"),
    [
        (signal.SIGHUP, "opening", "stopped"),
        (signal.SIGHUP, "sweep", "stopped"),
        (signal.SIGQUIT, "pause", "stopped"),
        (signal.SIGTERM, "packing", "complete"),
    ],
)
def test_a_signal_ends_in_a_safe_stop(number, phase, ending, tmp_path):
    outcome = fault_processes.signalled(number, phase, tmp_path)
    assert (outcome.ending, outcome.wrong, outcome.off) == (ending, 0, True)
    assert outcome.unconfirmed == ()


@pytest.mark.slow
def test_two_signals_during_slow_replies_switch_off_within_three_seconds(tmp_path):
    seconds, off, unconfirmed = fault_processes.impatience(tmp_path)
    assert seconds < 3
    assert off
    assert unconfirmed == ()


@pytest.mark.parametrize("phase", ["beginning", "amid", "packing"])
def test_a_disk_that_fills_up_ends_in_a_safe_stop_and_a_readable_file(tmp_path, phase):
    outcome = fault_processes.full_disk(tmp_path, phase)
    if outcome is None:
        pytest.skip("this user may not mount a small disk")
    ending = "complete" if phase == "packing" else "stopped"
    assert (outcome.ending, outcome.wrong, outcome.off) == (ending, 0, True)
    if phase == "amid":
        assert "free space on the disk" in outcome.reason


def test_a_computers_clock_that_is_set_back_changes_nothing_but_time_stamps(tmp_path):
    outcome = fault_processes.clock_set_back(tmp_path)
    assert (outcome.ending, outcome.good, outcome.wrong, outcome.off) == ("complete", 10, 0, True)


def test_a_run_in_work_is_left_alone(tmp_path):
    said, outcome = fault_processes.locked(tmp_path)
    assert "locked.h5" in said
    assert (outcome.ending, outcome.good, outcome.wrong) == ("complete", 10, 0)


@pytest.mark.slow
def test_what_is_left_of_killed_runs_is_right_and_can_be_gone_on_with(tmp_path):
    kills = fault_processes.killed(4, tmp_path, seed=3)
    assert kills.resumed >= 2
    assert (kills.damaged, kills.wrong, kills.bad) == (0, 0, 0)


def test_a_step_that_is_not_as_planned_is_seen(tmp_path):
    """The judge of all these tests: a plan of other volts than those that were played."""
    path = tmp_path / "undisturbed.h5"
    ended, unconfirmed, truth = struck.measured(NO_FAULT, path)
    undisturbed = struck.outcome_of(NO_FAULT, path, (ended, unconfirmed, truth))
    assert (undisturbed.good, undisturbed.wrong) == (10, 0)
    louder = [
        (
            time_s,
            state if state.drive_v == 0 else replace(state, drive_v=1.001 * state.drive_v),
        )
        for time_s, state in truth.changes
    ]
    other = struck.Truth(louder, truth.exposed_s)
    assert struck.outcome_of(NO_FAULT, path, (ended, unconfirmed, other)).wrong == 10
    early = {frame: began_s - 0.2 for frame, began_s in truth.exposed_s.items()}
    other = struck.Truth(truth.changes, early)
    assert struck.outcome_of(NO_FAULT, path, (ended, unconfirmed, other)).wrong == 10
