# `make run` and `make test` do all of the setting up themselves; nothing has to be installed before.
SHELL := /bin/bash
# A Python 3.11 or 3.12 to make .venv with; found on the PATH if not given.
PYTHON ?=
# Test processes.
WORKERS ?= 2
BIN := .venv/bin
SETUP := .venv/.installed
GL := .venv/.gl

# Networks this small are fastest on one thread, and test processes must not fight for cores.
export OMP_NUM_THREADS ?= 1
# Keeps pyright from asking the network for a newer version of itself.
export PYRIGHT_PYTHON_IGNORE_WARNINGS := 1

.PHONY: help run test slow lint format typecheck bench clean

help:  ## list these verbs
	@grep -hE '^[a-z]+:.*##' Makefile | sed -E 's/^([a-z]+):.*## */\1\t/' | expand -t 12

run: $(SETUP) $(GL)  ## the continual-learning experiment in its shortest form
	$(BIN)/python benchmarks/continual.py --preset quick

test: lint typecheck $(GL)  ## lint, type check and the fast tests: what CI runs
	$(BIN)/pytest -n $(WORKERS)

slow: $(SETUP) $(GL)  ## the tests that `make test` leaves out
	$(BIN)/pytest -n $(WORKERS) -m slow

lint: $(SETUP)  ## ruff, and whether all files are formatted
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

format: $(SETUP)  ## let ruff format and fix what it can
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

typecheck: $(SETUP)  ## pyright
	$(BIN)/pyright

bench: $(SETUP) $(GL)  ## speed: frames, updates, training steps, GWR-B
	$(BIN)/pip install -q -c constraints.txt -e '.[bench]'
	$(BIN)/python benchmarks/speed/throughput.py
	$(BIN)/python benchmarks/speed/gwr.py

clean:  ## remove caches and build leftovers, never .venv or runs
	rm -rf build dist ./*.egg-info .pytest_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -not -path './.venv/*' -prune -exec rm -rf {} +

# pip is the target, as a Python without ensurepip leaves a .venv that has everything but pip.
$(BIN)/pip:
	@for python in $(PYTHON) python3.11 python3.12 python3; do \
		if "$$python" -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 12))' 2>/dev/null; then \
			echo "Making .venv with $$("$$python" --version)"; \
			"$$python" -m venv --clear .venv && exit; \
			echo "$$python cannot make a virtual environment: install its venv package (Debian: apt-get install python3-venv)" >&2; \
			exit 1; \
		fi; \
	done; \
	echo "bgpo_trl needs Python 3.11 or 3.12, found $$(python3 --version 2>&1): install one or name it with make PYTHON=..." >&2; \
	exit 1

$(SETUP): pyproject.toml constraints.txt | $(BIN)/pip
	$(BIN)/pip install -c constraints.txt -e '.[dev]'
	@touch $@

$(GL): scripts/install_gl.sh | $(SETUP)
	@scripts/install_gl.sh $(BIN)/python
	@touch $@
