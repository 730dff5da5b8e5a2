# gdpro-sim: `make` prints this help, `make demo` runs the default scene, `make test` runs the tests.
PYTHON ?= python3
VENV   ?= .venv
SCENE  ?= rubber_duck
OUT    ?= out/$(notdir $(basename $(SCENE)))
PIP    := $(VENV)/bin/python -m pip
READY  := $(VENV)/.ready
DEV    := $(VENV)/.ready-dev

.PHONY: help setup demo test lint types wheel-test check bench clean

help:  ## print this help
	@echo "gdpro-sim: physically simulatable Gaussian assets"
	@echo
	@grep -hE '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/^([a-z-]+):.*## (.*)/  make \1\t\2/' | expand -t 20
	@echo
	@echo "  make demo SCENE=NAME|FILE.yaml runs another scene; $(VENV)/bin/gdpro --help lists the commands"

$(VENV)/bin/python:
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "gdpro-sim needs Python 3.11 or newer")'
	$(PYTHON) -m venv $(VENV)

$(READY): $(VENV)/bin/python pyproject.toml constraints.txt
	$(PIP) install --quiet --disable-pip-version-check -c constraints.txt -e .
	@touch $@

$(DEV): $(READY)
	$(PIP) install --quiet --disable-pip-version-check -c constraints.txt -e ".[dev]"
	@touch $@

setup: $(READY)  ## make the virtual environment and install the package

demo: $(READY)  ## generate a duck from words, drop it, print where the results lie
	$(VENV)/bin/gdpro simulate $(SCENE) -o $(OUT)

test: $(DEV)  ## run all tests (slow ones included, the wheel test excepted)
	$(VENV)/bin/python -m pytest -n 2 --dist worksteal -m "not wheel"

lint: $(DEV)  ## check style and formatting
	$(VENV)/bin/ruff check .
	$(VENV)/bin/ruff format --check .

types: $(DEV)  ## check types
	$(VENV)/bin/mypy

wheel-test: $(DEV)  ## build sdist and wheel, install the wheel elsewhere, run a scene with it
	$(VENV)/bin/python -m pytest -m wheel

check: lint types test wheel-test  ## everything CI runs

bench: $(DEV)  ## print the benchmark tables (minutes)
	$(VENV)/bin/python -m tests.benchmarks.bench_pipeline
	$(VENV)/bin/python -m tests.benchmarks.bench_splatting

clean:  ## remove the virtual environment and results
	rm -rf $(VENV) out build dist *.egg-info
