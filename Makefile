# make run       sets everything up, then measures and fits a reed on the simulated bench
# make test      sets everything up, then runs lint and all tests but the slow ones (5 minutes on two cores)
# make peers     installs emulators and peers (some GB; Debian packages, so as root or with sudo) and
#                tests against what others wrote
# make test-all  runs make test with its coverage, then the slow tests, then make peers
# make bench     prints every figure that the project claims
# make docs      builds the documentation: docs/_build/html/index.html

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
PROTOCOL ?= protocols/seriesA.yaml
# One thread per numerical routine: the bench has its own two, and more only wait for each other.
export OMP_NUM_THREADS ?= 1

# Cameras through Aravis need the system's Python, for which Debian packages its binding.
SYSTEM_PYTHON ?= /usr/bin/python3
ALL := .venv-all

# Four workers, also on two cores: for a third of the time tests wait for instruments.
# The tests of a file share fixtures: one worker runs them all.
PYTEST := $(BIN)/python -m pytest -q -n 4 --dist loadfile
# Files with a smaller coverage than this are listed, in per cent of their lines.
SHOW_BELOW := 80

.PHONY: run test peers test-all bench lint docs clean

run: .stamps/run
	$(BIN)/acquire run $(PROTOCOL)

test: .stamps/test lint
	$(PYTEST) -m "not slow" $(COVERAGE)

# Coverage is that of the tests of `make test`; alone these run without it, because it takes a third
# more time on Python 3.11. Code that a test runs in another process is not counted.
test-all: COVERAGE := --cov --cov-report=
test-all: test
	$(PYTEST) -m slow
	@$(BIN)/coverage report | awk '/%/ && ($$1 == "TOTAL" || $$NF + 0 < $(SHOW_BELOW)) {print "coverage", $$NF, $$1}'
	$(MAKE) peers

peers: .stamps/all
	$(ALL)/bin/python -m pytest -q -n 4 --dist loadfile \
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

docs: .stamps/docs
	$(BIN)/python -m sphinx --builder html --fail-on-warning --keep-going --quiet docs docs/_build/html
	@echo "open docs/_build/html/index.html"

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

.stamps/docs: .stamps/venv pyproject.toml constraints.txt
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable ".[docs]"
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
	rm -rf $(VENV) $(ALL) .stamps build dist docs/_build *.egg-info
