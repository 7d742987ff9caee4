# make run    sets everything up, then measures and fits a reed on the simulated bench
# make test   sets everything up, then checks everything
# make bench  prints every figure that the project claims

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
PROTOCOL ?= protocols/seriesA.yaml
# One thread per numerical routine: the bench has its own two, and more only wait for each other.
export OMP_NUM_THREADS ?= 1

.PHONY: run test bench lint clean

run: .stamps/run
	$(BIN)/acquire run $(PROTOCOL)

test: .stamps/test lint
	$(BIN)/python -m pytest -q -n 2 --dist loadfile

lint: .stamps/test
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

bench: .stamps/bench
	$(BIN)/python -m benchmarks

.stamps/venv:
	@$(PYTHON) -c "import sys; sys.exit(sys.version_info < (3, 11))" \
	  || { echo "Python 3.11 or later is needed; name one: make run PYTHON=python3.12"; exit 1; }
	$(PYTHON) -m venv $(VENV)
	@mkdir -p .stamps && touch $@

.stamps/run: .stamps/venv pyproject.toml
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable .
	@touch $@

.stamps/test: .stamps/venv pyproject.toml
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable ".[dev]"
	@touch $@

.stamps/bench: .stamps/venv pyproject.toml
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable ".[bench]"
	@touch $@

clean:
	rm -rf $(VENV) .stamps build dist *.egg-info
