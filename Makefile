# `make` alone says what there is. Python >= 3.11 is all that has to be there; take another one with
# `make PYTHON=python3.12 ...`. pip's own variables work as usual, for example to point at another index.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
# The versions to install: make CONSTRAINTS=constraints-oldest.txt test, or none, make CONSTRAINTS= test, for the newest.
CONSTRAINTS := constraints.txt
# What builds the package, as pyproject.toml asks for it: a venv of Python 3.11 brings an older one.
BUILD := $(shell sed -n 's/^requires = \["\(setuptools[^"]*\)"\].*/\1/p' pyproject.toml)
# Python compiles a module when it is first imported; most of torch, scipy and others never are, and it is half of an install.
PIP := $(BIN)/python -m pip --disable-pip-version-check install -qq --no-compile $(addprefix -c ,$(CONSTRAINTS))
TEST_EXTRAS := rl,render,peers,db,samplers,nuts,parquet,recorders,units,frames,explore,dev,torch,learned
BENCH_EXTRAS := rl,peers,bench
DOCS_EXTRAS := docs,rl,frames
ARGS :=
# Images of Docker often forbid Python to keep what it compiles: each of the tests' processes would compile all it imports.
unexport PYTHONDONTWRITEBYTECODE

# Stamps: present only after a complete install, so a second run needs no network and an interrupted one starts over.
MADE := $(VENV)/.made
BASE := $(VENV)/.base
TEST := $(VENV)/.test
BENCH := $(VENV)/.bench
DOCS := $(VENV)/.docs

# A `pip install .` of somebody's puts a copy in place of this folder: then nothing here is installed any more. And older
# versions kept machine code beside such a copy, which outlives it as an empty package and hides ours: away with that.
ifneq ($(wildcard $(MADE)),)
ifeq ($(wildcard $(VENV)/[Ll]ib*/python*/site-packages/__editable__.thruster_env-*),)
$(shell rm -f $(BASE) $(TEST) $(BENCH) $(DOCS))
endif
endif
TIDY := $(BIN)/python -c 'from thruster_env.core import modules; modules.tidy()'

.PHONY: help demo test test-slow test-all bench docs fuzz lint clean
.NOTPARALLEL:

help: ## this list
	@sed -n 's/^\([a-z-]*\):.*## \(.*\)/  make \1 - \2/p' Makefile

demo: $(BASE) ## install what is needed (once), tune a filter, prove it, report it
	@$(BIN)/thruster demo $(ARGS)

test: $(TEST) ## install what tests need (once) and run all but the slow tests; ARGS="-k name" picks some
	@$(BIN)/python -m pytest -m "not slow" $(ARGS)

test-slow: $(TEST) ## run the slow tests: whole studies, whole pages, the benchmark
	@$(BIN)/python -m pytest -m slow $(ARGS)

test-all: $(TEST) ## run all tests in one go, as continuous integration does
	@$(BIN)/python -m pytest $(ARGS)

bench: $(BENCH) ## install what benchmarks need (once) and time it against other packages, side by side
	@$(BIN)/python -m benchmarks $(ARGS)

docs: $(DOCS) ## install what the site needs (once) and build it into build/docs; ARGS=linkcheck tries external links
	@$(BIN)/python -m sphinx -b $(or $(ARGS),html) -W --keep-going -q $(SPHINXOPTS) docs build/docs
	@echo "build/docs/index.html"

fuzz: $(TEST) ## attack everything at random for ten minutes; ARGS="--seconds 60 --seed 1"
	@$(BIN)/python -m tests.fuzz $(ARGS)

lint: $(TEST) ## check style, formatting and types
	@$(BIN)/ruff check .
	@$(BIN)/ruff format --check .
	@$(BIN)/python -m mypy

clean: ## remove .venv, build products and caches; results in out/ stay
	rm -rf $(VENV) docs/tutorials build dist *.egg-info .pytest_cache .ruff_cache .mypy_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

$(MADE):
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null || { echo "make: Python 3.11 or later is needed, and '$(PYTHON)' is not: name one with make PYTHON=..." >&2; exit 1; }
	@$(PYTHON) -m venv --clear $(VENV)
	@touch $@

# The build tool comes first, pinned like the rest, so that pip does not fetch an unpinned one behind our back. The extras
# are pinned by the same file, so neither install changes a version that the other one put there.
$(BASE): pyproject.toml $(CONSTRAINTS) | $(MADE)
	@echo "installing the base into $(VENV) (once, about a minute) ..."
	@rm -f $(BASE) $(TEST) $(BENCH) $(DOCS)
	@$(PIP) '$(BUILD)'
	@$(PIP) --no-build-isolation -e .
	@$(TIDY)
	@touch $(BASE)

$(TEST): EXTRAS := $(TEST_EXTRAS)
$(BENCH): EXTRAS := $(BENCH_EXTRAS)
$(DOCS): EXTRAS := $(DOCS_EXTRAS)
$(TEST) $(BENCH) $(DOCS): pyproject.toml $(CONSTRAINTS) | $(MADE)
	@echo "installing what tests, benchmarks or the site need into $(VENV) (once, some minutes) ..."
	@rm -f $(BASE) $@
	@$(PIP) '$(BUILD)'
	@$(PIP) --no-build-isolation -e ".[$(EXTRAS)]"
	@$(TIDY)
	@touch $(BASE) $@
