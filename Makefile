# Commands set up .venv when they need it; nothing has to be installed before.
SHELL := /bin/bash
# Python 3.11 or 3.12 for .venv; by default, the first one on the PATH.
PYTHON ?=
# Number of test processes.
WORKERS ?= 2
BIN := .venv/bin
SETUP := .venv/.installed
GL := .venv/.gl
# A file's tests stay in one process, which makes what they share only once.
PYTEST = $(BIN)/pytest -n $(WORKERS) --dist loadfile

# Small networks are fastest on one thread, and test processes compete for cores.
export OMP_NUM_THREADS ?= 1
# Keeps pyright from checking online for a newer version.
export PYRIGHT_PYTHON_IGNORE_WARNINGS := 1

.PHONY: help run test slow lint format typecheck docs bench clean

help:  ## list these commands
	@grep -hE '^[a-z]+:.*##' Makefile | sed -E 's/^([a-z]+):.*## */\1\t/' | expand -t 12

run: $(SETUP) $(GL)  ## the continual-learning experiment in its shortest form
	$(BIN)/python benchmarks/continual.py --preset quick

test: lint typecheck $(GL)  ## lint, type check and the fast tests, as in CI
	$(PYTEST)

slow: $(SETUP) $(GL)  ## the tests that take more than a few seconds each
	$(PYTEST) -m slow

lint: $(SETUP)  ## ruff, and a check of the formatting
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

format: $(SETUP)  ## format, and apply ruff's automatic fixes
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

typecheck: $(SETUP)  ## pyright
	$(BIN)/pyright

docs: $(SETUP)  ## the documentation as a site, build/site/index.html
	$(BIN)/python scripts/site_pages.py build/pages
	$(BIN)/zensical build --strict --clean

bench: $(SETUP) $(GL)  ## speed of frames, updates, training steps and GWR-B
	$(BIN)/pip install -q -c constraints.txt -e '.[bench]'
	$(BIN)/python benchmarks/speed/throughput.py
	$(BIN)/python benchmarks/speed/gwr.py

clean:  ## remove caches and build leftovers, never .venv or runs
	rm -rf build dist ./*.egg-info .pytest_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -not -path './.venv/*' -prune -exec rm -rf {} +

# The target is pip, since a Python without ensurepip leaves a .venv without it.
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
