# make run    two minutes of HalfCheetah learning in real time, recorded
# make test   the tests
# make check  format, lint, types, import rules
# make clean  remove the environment and the caches; runs/ stays
#
# Needs python3.11, git and make. Other interpreter: make run PYTHON=/path/to/python3.11

PYTHON ?= python3.11
BIN := .venv/bin
STAMP := .venv/.installed-$(shell cat requirements.lock pyproject.toml | cksum | cut -d ' ' -f 1)
PIP := $(BIN)/python -m pip install --quiet --quiet --disable-pip-version-check --no-input

.DEFAULT_GOAL := help
.PHONY: help run test check clean

help:
	@sed -n 's/^# //p' Makefile

run: $(STAMP)
	@$(BIN)/tenuto run halfcheetah --duration-s 120

test: $(STAMP)
	@$(BIN)/python -m pytest

check: $(STAMP)
	@$(BIN)/ruff format --check .
	@$(BIN)/ruff check .
	@$(BIN)/mypy
	@$(BIN)/lint-imports

clean:
	rm -rf .venv build *.egg-info .mypy_cache .pytest_cache .ruff_cache .import_linter_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

# The stamp carries the hash of what is to be installed, so a changed lock file installs again.
$(STAMP): requirements.lock pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info[:2] != (3, 11))' || \
	  { echo "tenuto: PYTHON = $(PYTHON): must be a Python 3.11 interpreter" >&2; exit 2; }
	@echo "[1/3] environment in .venv"
	@$(BIN)/python -m pip --version >/dev/null 2>&1 || $(PYTHON) -m venv --clear .venv
	@echo "[2/3] packages of requirements.lock (the first time this takes some minutes)"
	@$(PIP) -r requirements.lock
	@echo "[3/3] tenuto"
	@$(PIP) --no-deps --no-build-isolation -e .
	@rm -f .venv/.installed-*
	@touch $@
