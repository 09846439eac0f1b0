# Two commands matter: `make demo` and `make test`. Each makes what it needs first.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
OUT ?= demo-out

# Bytecode is kept even where the environment forbids it: the tests start many short processes.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: all demo test lint bench study clean

all: $(STAMP)

# The lock file pins every package by hash; the project itself is installed editable on top.
$(STAMP): requirements.lock pyproject.toml
	@echo "bramah: making $(VENV) with the locked dependencies (a few minutes the first time)"
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
		{ echo "bramah: Python 3.11 or newer is needed; name one with: make PYTHON=python3.12"; exit 1; }
	@$(PYTHON) -m venv $(VENV)
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check --require-hashes -r requirements.lock
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps -e .
	@touch $@
	@echo "bramah: $(VENV) is ready"

demo: $(STAMP)
	@$(BIN)/bramah demo --out $(OUT)

lint: $(STAMP)
	@$(BIN)/ruff format --quiet --check .
	@$(BIN)/ruff check --quiet .
	@$(BIN)/mypy --num-workers 2 --no-error-summary
	@$(BIN)/vulture
	@$(BIN)/lint-imports --no-cache > .lint-imports.log || { cat .lint-imports.log; exit 1; }
	@rm -f .lint-imports.log

test: lint
	@$(BIN)/python -m pytest

bench: $(STAMP)
	@$(BIN)/bramah bench

# Slow evidence: `make study` lists the studies, `make study NAME="trace --quick"` runs one.
study: $(STAMP)
	@$(BIN)/python -m tests.studies $(or $(NAME),--help)

clean:
	rm -rf $(VENV) $(OUT) .pytest_cache .mypy_cache .ruff_cache .hypothesis
