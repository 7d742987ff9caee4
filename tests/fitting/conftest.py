"""One sweep of the simulated bench, measured and fitted once, and copies of it with changes."""

import shutil
from pathlib import Path

import numpy as np
import pytest
import yaml

from acquire.runner import script
from benchmarks.recovery import true_frequencies_hz
from fitting.cane.fit_runs import fit_runs
from fitting.forward import finite_element_model
from physics.reed.cache import reduced_reed
from physics.reed.viscoelastic import Series

REED = "R07"


@pytest.fixture(scope="session")
def tables():
    """The paper's numbers, where they lie beside the checkout."""
    path = Path(__file__).parents[3] / "shared" / "paper" / "tables.yaml"
    if not path.exists():
        pytest.skip("the paper's tables.yaml does not lie beside this checkout")
    return yaml.safe_load(path.read_text())


@pytest.fixture(scope="session")
def reed():
    return reduced_reed()


@pytest.fixture(scope="session")
def model(reed):
    """Finite elements, tabulated once: it takes over a second."""
    return finite_element_model(reed)


@pytest.fixture(scope="session")
def sweep_a(made_once):
    """Run file of series A on a quarter of the sensor: 87 steps of 50 cents, all noise on."""
    small = {"camera.width": 640, "camera.height": 512, "sweep.stride": 2, "sweep.last": 173}
    plan = script.plan(script.load("seriesA").replace(small))
    return made_once("A.h5", lambda path: script.run(plan, path, reed=REED))


@pytest.fixture(scope="session")
def fitted(sweep_a):
    """What `acquire fit --method picture` makes of that run."""
    return fit_runs([sweep_a], method="picture")


@pytest.fixture(scope="session")
def fitted_a(fitted):
    """The resonances of that run."""
    return fitted.sweeps[0]


@pytest.fixture(scope="session")
def true_hz():
    """Eigenfrequencies of that reed in series A, by name."""
    return true_frequencies_hz(REED, Series.A)


@pytest.fixture
def changed(sweep_a, tmp_path, resealed):
    """Return a function that copies the run file with changes.

    Of the steps in `only` (first and last k) the verdicts stay, the others become pending;
    `verdicts` gives some by k; `order` permutes the steps; labels replace what stands in the file.
    """

    def make(file_name="changed.h5", only=None, verdicts=None, order=None, **labels):
        path = Path(shutil.copy(sweep_a, tmp_path / file_name))
        with resealed(path) as file:
            steps = file["entry/steps"]
            index, said = steps["index"][()], steps["verdict"][()]
            if only is not None:
                said[(index < only[0]) | (index > only[1])] = b"pending"
            for k, verdict in (verdicts or {}).items():
                said[index == k] = verdict.encode()
            steps["verdict"][...] = said
            if order is not None:
                for column in (*steps.values(), file["entry/data/field"]):
                    column[...] = column[()][np.asarray(order)]
            for key, text in labels.items():
                del file["entry/sample"][key]
                file["entry/sample"][key] = text
        return path

    return make
