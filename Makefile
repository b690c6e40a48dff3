# `make demo` and `make test` do everything on a machine that has Python >= 3.11 and make.
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
STUDY := $(VENV)/.study
DEV := $(VENV)/.dev
SITE := $(VENV)/.site
# PYTHON given by hand is what runs: it is looked for in pyenv's versions too, and an environment of
# another version is made again.
ifeq ($(origin PYTHON), command line)
override PYTHON := $(or $(shell python3 .ci/interpreter.py $(PYTHON)),$(PYTHON))
ifneq ($(wildcard $(BIN)/python),)
ifneq ($(shell $(PYTHON) -V), $(shell $(BIN)/python -V))
.PHONY: $(BIN)/python
endif
endif
endif
# Modules are compiled when they are first imported: most of what is installed never is.
PIP := $(BIN)/python -m pip install --quiet --no-compile
# A quarter of the tests and more, in two minutes: what another Python, NumPy or JAX breaks first
# (imports, every kind of input at every entry, pickling), oracles and closed forms.
QUARTER := tests/oracles tests/test_architecture.py tests/test_checks.py tests/test_models.py \
   tests/test_sensors.py tests/test_face.py tests/faults/test_times.py \
   tests/faults/test_stream_inputs.py tests/faults/test_values_out_of_domain.py \
   tests/faults/test_every_run_every_entry.py tests/faults/test_pickling.py \
   tests/faults/test_singular_priors.py tests/papers/test_yoder_closed_forms.py \
   tests/papers/test_anderson.py
PYTEST := $(BIN)/python -m pytest -n auto --dist loadgroup --no-loadscope-reorder

.PHONY: demo test test-all test-newest test-oldest test-versions test-quarter dist lint types check site docs bench reproduce clean

demo: $(STUDY)  ## the sine experiment: filtered, tuned by gradient, drawn
	$(BIN)/ewif-jax study sine --overwrite

test: $(DEV)  ## all tests, on all cores
	$(PYTEST)

test-all: $(DEV)  ## the slow ones too
	$(PYTEST) --all

test-newest:  ## all tests on the newest Python here, with the newest JAX, in .venv-newest
	newest=$$($(PYTHON) .ci/interpreter.py newest) && $(MAKE) test VENV=.venv-newest PYTHON="$$newest"

test-oldest:  ## a quarter of them with the oldest package versions allowed, in .venv-oldest
	mkdir -p build
	$(PYTHON) .ci/oldest.py lab study > build/oldest.txt
	PIP_CONSTRAINT=$(abspath build/oldest.txt) $(MAKE) test-quarter VENV=.venv-oldest

test-versions:  ## a quarter of them on every Python here from 3.11 on, with the newest packages
	for name in python3.11 python3.12 python3.13; do \
	  found=$$($(PYTHON) .ci/interpreter.py $$name); \
	  if [ -z "$$found" ]; then echo "There is no $$name here: not run."; continue; fi; \
	  $(MAKE) test-quarter VENV=.venv-$$name PYTHON="$$found" || exit 1; \
	done

dist: $(DEV)  ## wheel and source in dist/, checked, and the wheel alone in an environment of its own
	$(PIP) -e ".[release]"
	rm -rf dist
	$(BIN)/python -m build --outdir dist
	$(BIN)/python -m twine check --strict dist/*
	$(BIN)/python .ci/wheel.py dist

test-quarter: $(DEV)
	$(PYTEST) $(QUARTER)

lint: $(DEV)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(DEV)
	$(BIN)/pyright

check: lint types test

site: $(SITE)  ## the pages, in build/site; a warning is an error
	$(BIN)/python docs/site/build.py

docs: site $(DEV)  ## the same, and everything on them is run: notebooks, blocks, guides
	$(BIN)/python -m pytest --all tests/test_site.py tests/test_readme.py tests/test_guides.py \
	   tests/lab/test_guide.py tests/test_notebooks.py

reproduce: $(STUDY)  ## every published experiment at full size
	$(BIN)/ewif-jax study all --overwrite

bench: $(DEV)
	$(PIP) -e ".[bench]"
	$(BIN)/python -m benchmarks.bench_linear

$(BIN)/python:
	$(PYTHON) -c 'import sys; assert sys.version_info >= (3, 11), "Python 3.11 or newer is needed"'
	$(PYTHON) -m venv --clear $(VENV)

$(STUDY): $(BIN)/python pyproject.toml
	$(PIP) -e ".[study]"
	touch $@

$(DEV): $(BIN)/python pyproject.toml
	$(PIP) -e ".[dev]"
	touch $@ $(STUDY)

$(SITE): $(BIN)/python pyproject.toml
	$(PIP) -e ".[site]"
	touch $@

clean:
	rm -rf .venv .venv-* build dist results
