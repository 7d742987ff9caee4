# make run    sets everything up, then measures and fits a reed on the simulated bench
# make test   sets everything up, then checks everything
# make bench  prints every figure that the project claims
# make test-all  installs emulators and peers too (some GB; Debian packages, so as root or with
#             sudo), then tries instruments, wires and documents against what others wrote

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
PROTOCOL ?= protocols/seriesA.yaml
# One thread per numerical routine: the bench has its own two, and more only wait for each other.
export OMP_NUM_THREADS ?= 1

# Cameras through Aravis need the system's Python, for which Debian packages its binding.
SYSTEM_PYTHON ?= /usr/bin/python3
ALL := .venv-all

.PHONY: run test test-all bench lint clean

run: .stamps/run
	$(BIN)/acquire run $(PROTOCOL)

test: .stamps/test lint
	$(BIN)/python -m pytest -q -n auto --maxprocesses 4 --dist loadfile

test-all: .stamps/all
	$(ALL)/bin/python -m pytest -q -n auto --maxprocesses 4 --dist loadfile \
	  tests/peers tests/fitting/modal/test_modal_peer.py tests/drivers tests/acquire/cli/test_emulated.py \
	  tests/acquire/cli/test_faults.py

lint: .stamps/test
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

# Both print to the end, whatever fails; the exit status is that of the first that failed.
bench: .stamps/bench
	$(BIN)/python -m benchmarks; status=$$?; $(BIN)/python -m studies && exit $$status

.stamps/venv:
	@$(PYTHON) -c "import sys; sys.exit(sys.version_info < (3, 11))" \
	  || { echo "Python 3.11 or later is needed; name one: make run PYTHON=python3.12"; exit 1; }
	$(PYTHON) -m venv $(VENV)
	@mkdir -p .stamps && touch $@

.stamps/run: .stamps/venv pyproject.toml constraints.txt
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable .
	@touch $@

.stamps/test: .stamps/venv pyproject.toml constraints.txt
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable ".[dev]"
	@touch $@

.stamps/bench: .stamps/venv pyproject.toml
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable ".[bench]"
	@touch $@

.stamps/all: pyproject.toml .ci/emulators
	.ci/emulators
	$(SYSTEM_PYTHON) -m venv --system-site-packages $(ALL)
	$(ALL)/bin/python -m pip install --quiet --disable-pip-version-check \
	  --editable ".[dev,bench,basler,peers]"
	@mkdir -p .stamps && touch $@

clean:
	rm -rf $(VENV) $(ALL) .stamps build dist *.egg-info
