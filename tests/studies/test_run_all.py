"""Programs that run others: help and wrong names run none, a name runs that one."""

import pytest

from studies.run_all import run_all

COMMANDS = ("timeit --number 1 --repeat 1 pass", "no_module_of_this_name")


def run(*words):
    return run_all(COMMANDS, "python -m some", "Print something.", words)


@pytest.mark.parametrize(("words", "status"), [(["--help"], 0), (["timeit", "platform"], 2)])
def test_help_and_wrong_names_run_nothing(capfd, words, status):
    with pytest.raises(SystemExit) as ended:
        run(*words)
    assert ended.value.code == status
    out, err = capfd.readouterr()
    assert "==" not in out
    assert "timeit" in out + err


def test_a_name_runs_that_one_with_its_arguments(capfd):
    assert run("timeit") == 0
    out, _ = capfd.readouterr()
    assert out.startswith("== timeit")
    assert "1 loop" in out


def test_the_largest_exit_status_is_that_of_all(capfd):
    assert run() == 1
    assert capfd.readouterr().out.count("==") == 2
