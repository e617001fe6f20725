# Sets itself up: `make demo` and `make test` need Python 3.10-3.12 and make, nothing else.
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin

.PHONY: help setup demo test lint format wheel clean
help:
	@echo "make demo    synthesise a drive, train with and without the depth prior, compare (outputs/demo/)"
	@echo "make test    run all tests"
	@echo "make lint    ruff and pyright"
	@echo "make setup   the virtual environment in $(VENV), with the versions of constraints.txt"

# OpenCV comes in several wheels that overwrite each other; the one with contrib and without a window goes last.
$(VENV)/.installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[dev]'
	$(BIN)/pip install --quiet --disable-pip-version-check -c constraints.txt --no-deps --force-reinstall opencv-contrib-python-headless
	touch $@

setup: $(VENV)/.installed

demo: setup
	$(BIN)/edge-depth-nerf demo --output outputs/demo

test: setup
	$(BIN)/pytest

lint: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright

format: setup
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

wheel: setup
	$(BIN)/python -m build --wheel

clean:
	rm -rf build dist outputs *.egg-info .pytest_cache .ruff_cache
