"""Measure how musical reeds vibrate, and fit their cane: the functions for scripts.

    >>> import acquire
    >>> plan = acquire.plan("quick")
    >>> plan
    <SweepPlan: Quick look on simulated bench: 87 steps, 35 s, 13 MB, can be measured>

`load`, `plan`, `run` and `open_run` measure. `fit`, `acoustics`, `modes`, `population` and
`diagnose` analyse.
The command line calls the same functions.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from acquire.analysis import acoustics, fit, modes, population
    from acquire.campaigns import (
        load_campaign,
        plan_campaign,
        resume_campaign,
        run_campaign,
    )
    from acquire.diagnosing import diagnose, diagnose_resonances
    from acquire.measurement import load, open_run, pack, plan, resume, run
    from acquire.runner.callbacks import Callbacks
    from runs.layout import RunLabels

# Where each public name is defined. Modules are imported when a name is first used, so that
# `acquire --help` does not wait for numerical libraries.
_HOMES = {
    "load": "acquire.measurement",
    "plan": "acquire.measurement",
    "run": "acquire.measurement",
    "resume": "acquire.measurement",
    "open_run": "acquire.measurement",
    "pack": "acquire.measurement",
    "load_campaign": "acquire.campaigns",
    "plan_campaign": "acquire.campaigns",
    "run_campaign": "acquire.campaigns",
    "resume_campaign": "acquire.campaigns",
    "fit": "acquire.analysis",
    "acoustics": "acquire.analysis",
    "modes": "acquire.analysis",
    "population": "acquire.analysis",
    "diagnose": "acquire.diagnosing",
    "diagnose_resonances": "acquire.diagnosing",
    "Callbacks": "acquire.runner.callbacks",
    "RunLabels": "runs.layout",
}

__all__ = [
    "Callbacks",
    "RunLabels",
    "acoustics",
    "diagnose",
    "diagnose_resonances",
    "fit",
    "load",
    "load_campaign",
    "modes",
    "open_run",
    "pack",
    "plan",
    "plan_campaign",
    "population",
    "resume",
    "resume_campaign",
    "run",
    "run_campaign",
]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'acquire' has no attribute {name!r}")
    return getattr(import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    return sorted(__all__)
