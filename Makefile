# `make train` and `make test` need Python 3.10 to 3.13 and make, nothing else: they set up .venv first.

VENV ?= .venv
ARGS ?=
# Another place to take torch from, as a URL for pip's --index-url. Empty: as pip is configured.
TORCH_INDEX_URL ?=

IS_SUPPORTED := import sys; sys.exit(not (3, 10) <= sys.version_info[:2] <= (3, 13))
# 3.11 first: the last version for which PyBullet has a wheel.
PYTHON ?= $(shell for python in python3.11 python3 python3.12 python3.13 python3.10 python; do \
	if $$python -c "$(IS_SUPPORTED)" >/dev/null 2>&1; then echo $$python; break; fi; done)

BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
REQUIREMENTS := requirements.txt requirements-no-deps.txt pyproject.toml

.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
.PHONY: help setup train test test-slow test-versions lint docs

help:
	@echo "make setup      create $(VENV) with everything this project uses"
	@echo "make train      the quick start: train, evaluate, write curves and a video"
	@echo "make test       the tests (minutes)"
	@echo "make test-slow  products of tasks, robots and networks, many episodes"
	@echo "make test-versions  the lowest and newest versions, in fresh environments (gigabytes)"
	@echo "make docs       the site, in docs/_build/html"
	@echo "make lint       check style; list long files, deep classes and lines to read"
	@echo
	@echo "ARGS='...' is passed on: make train ARGS='seed=1', make test ARGS='-k vector'."
	@echo "PYTHON=/path/to/python3.11 names the interpreter if it is not found."
	@echo "TORCH_INDEX_URL=... makes setup take another build of torch."

setup: $(STAMP)

train: $(STAMP)
	$(BIN)/ba-torchrl train --config-name quickstart $(ARGS)

# One process per core, each with one thread: numeric libraries would fight over the cores. At most
# eight, which take 12 GB. The tests of a file run in one process, which builds their environments
# and kernels once. A test that ends its process is repeated in a new one, by default four times per
# core.
PYTEST := OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n auto --maxprocesses 8 --dist loadfile \
	--max-worker-restart 1

test: $(STAMP)
	$(PYTEST) $(ARGS)

test-slow: $(STAMP)
	$(PYTEST) -m slow --timeout 3600 -o faulthandler_timeout=3660 $(ARGS)

test-versions: $(STAMP)
	$(BIN)/python tests/versions.py $(ARGS)

lint: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/python -m docs.layout

docs: $(STAMP)
	$(BIN)/python -m sphinx --fail-on-warning --keep-going -q -b html docs docs/_build/html $(ARGS)

# The stamp comes last, so an interrupted set-up is taken up again. One recipe, so that -j
# cannot reorder it: torch goes first, or a requirement would pull in another build of it.
$(STAMP): $(REQUIREMENTS)
	@rm -f $(STAMP)
	@if ! $(BIN)/python -c "import pip; $(IS_SUPPORTED)" >/dev/null 2>&1; then \
		if ! "$(PYTHON)" -c "$(IS_SUPPORTED)" >/dev/null 2>&1; then \
			echo "Python 3.10 to 3.13 is needed." >&2; \
			echo "$(if $(PYTHON),'$(PYTHON)' is not one,None was found): make PYTHON=/path/to/python3.11 ..." >&2; \
			exit 1; \
		fi; \
		echo "Creating $(VENV)"; \
		"$(PYTHON)" -m venv --clear $(VENV); \
	fi
	@echo "Installing torch"
	@$(BIN)/python -m pip install $(if $(TORCH_INDEX_URL),--index-url $(TORCH_INDEX_URL)) \
		"$$(grep '^torch==' requirements.txt)"
	@echo "Installing the other requirements"
	@$(BIN)/python -m pip install -r requirements.txt
	@$(BIN)/python -m pip install --no-deps -r requirements-no-deps.txt
	@$(BIN)/python -m pip install --no-deps -e .
	@touch $(STAMP)
