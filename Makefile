# Sets itself up: `make demo` and `make test` need Python 3.10-3.12 and make, nothing else.
PYTHON ?= python3
VENV ?= .venv
# where Windows' Python puts programs
SCRIPTS := $(if $(filter Windows_NT,$(OS)),Scripts,bin)
BIN := $(VENV)/$(SCRIPTS)

.PHONY: help setup demo real gpu test test-fast test-pure coverage fuzz audit lint format docs dist check-dist version notes clean
help:
	@echo "make demo        synthesise a drive, train with and without the depth prior, compare (outputs/demo/)"
	@echo "make real        all methods on real drives, with three seeds (REAL='their folders'; some hours)"
	@echo "make gpu         what a GPU makes of it: start, steps, kernels, trainings, tests (outputs/gpu/report.md; eight minutes)"
	@echo "make test-fast   tests of what needs no nerfstudio and a smoke run of the plugin, in a minute and a half"
	@echo "make test        run all tests, in 25 minutes"
	@echo "make test-pure   tests of the modules that need no nerfstudio, under NumPy 2"
	@echo "make coverage    all tests, and which lines and branches they run"
	@echo "make fuzz        a thousand spoilt files for every reader, then a coverage-guided fuzzer (half an hour)"
	@echo "make audit       known faults of the installed packages (asks the network)"
	@echo "make lint        ruff, import-linter, the prose rules and pyrefly"
	@echo "make docs        the pages as a site (site/)"
	@echo "make check-dist  build wheel and sdist (dist/), install them into a fresh environment"
	@echo "make setup       the virtual environment in $(VENV), with the versions of constraints.txt"

# What the packages take, and what pip needs in the folder of temporary files until it has moved them.
PACKAGES_GB := 9.7
TEMPORARY_GB := 3.6

# uv takes a minute where pip takes five. It does not read pip's settings: where it gets nothing, pip installs. OpenCV comes
# in several wheels that overwrite each other; the one with contrib and without a window goes last. Bytecode of all
# packages would take two minutes; Python makes that of what is imported.
PIP = $(BIN)/pip install --quiet --disable-pip-version-check --no-compile -c constraints.txt
UV = $(BIN)/uv pip install --cache-dir $(VENV)/.uv --python $(BIN)/python -c constraints.txt
$(VENV)/.installed: pyproject.toml constraints.txt
	@$(PYTHON) .ci/enough_space.py $(VENV) $(PACKAGES_GB) $(TEMPORARY_GB)
	@echo "Installing into $(VENV): a minute with uv, some with pip, which prints nothing while it works; 9 GB."
	$(PYTHON) -m venv $(VENV)
	$(PIP) uv && $(UV) -e '.[dev]' || $(PIP) -e '.[dev]'
	rm -rf $(VENV)/.uv
	$(PIP) --no-deps --force-reinstall opencv-contrib-python-headless
	touch $@

setup: $(VENV)/.installed

demo: setup
	$(BIN)/edge-depth-nerf demo --output outputs/demo

# All methods on recordings of yours (docs/results.md says which): make real REAL="FOLDER FOLDER@2"; some hours. @2: half size.
real: setup
	@test -n "$(REAL)" || { echo "Give the folders of real drives: make real REAL='FOLDER FOLDER'"; exit 2; }
	$(BIN)/python -m benchmarks.quality.real_drive $(REAL) --output outputs/real_drive

# In parts that have limits; called again it does what is missing. GPU=--fake goes the same way without a GPU.
gpu: setup
	$(BIN)/python -m benchmarks.speed.gpu $(GPU)

# In a folder of their own, which is removed if they pass; of those that fail it can be looked at.
in_a_folder = folder=$$(mktemp -d) && if $(BIN)/pytest --basetemp=$$folder/tests $(1); then rm -rf $$folder; else \
	echo "What the tests wrote is in $$folder"; exit 1; fi

test-fast: setup
	@$(call in_a_folder,--fast -p no:cacheprovider)

test: setup
	@$(call in_a_folder,)

# Lines and branches of whatever the tests run in their own process, then of the pure rooms alone, which must have 95 %.
# Functions that Numba or Triton compile run unseen; pyproject.toml leaves them out, and tests compare them with twins.
PURE_ROOMS := $(patsubst %,edge_depth_nerf/%/*,method scene base cameras lidar masks)
coverage: setup
	@$(call in_a_folder,--cov --cov-report=)
	$(BIN)/coverage report
	$(BIN)/coverage report --fail-under=95 --include="$$(echo '$(PURE_ROOMS)' | tr ' ' ,)"

# The modules that need no nerfstudio, whose dependencies still pin NumPy 1.26 (its issue 3747), under NumPy 2. Tests that
# compare with nerfstudio have its name in theirs.
PURE := build/pure
PURE_TESTS := alignment bad_input calibration camera_fit cameras faults files integration kitti360 lidar losses masks mono_files \
	pixel_table poses prior rays scans scene sweeps_in_world trajectory
test-pure:
	rm -rf $(PURE)
	$(PYTHON) -m venv $(PURE)
	$(PURE)/$(SCRIPTS)/pip install --quiet --disable-pip-version-check 'numpy>=2' torch scipy opencv-contrib-python-headless numba \
		jaxtyping 'beartype>=0.18' tyro rich safetensors trimesh embreex Pillow PyYAML pycolmap python-neo-lzf pydantic \
		'pytest>=8' 'pytest-xdist>=3.7' 'hypothesis>=6'
	$(PURE)/$(SCRIPTS)/pip install --quiet --disable-pip-version-check --no-deps -e .
	$(PURE)/$(SCRIPTS)/pytest $(PURE_TESTS:%=tests/test_%.py) -k 'not nerfstudio and not all_models and not tuned'

# atheris has wheels for Linux and Python 3.11 or newer; elsewhere the second part is left out.
fuzz: setup
	$(BIN)/pip install --quiet --disable-pip-version-check -e '.[fuzz]' -c constraints.txt
	BAD_INPUTS=1000 $(BIN)/pytest tests/test_bad_input.py tests/test_nothing_unsafe.py
	$(BIN)/python -c 'import atheris' && $(BIN)/python tests/fuzz_parsers.py

# Exceptions, each with its reason, stand in AUDIT_EXCEPTIONS. There are none beside this project, which is on no index.
AUDIT_EXCEPTIONS ?=
audit: setup
	$(BIN)/pip install --quiet --disable-pip-version-check pip-audit
	$(BIN)/pip-audit --skip-editable --progress-spinner off $(AUDIT_EXCEPTIONS)

lint: setup
	$(BIN)/lint-imports --no-cache
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/python docs/check_prose.py
	$(BIN)/pyrefly check --min-severity error

format: setup
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

# Material for MkDocs prints an advertisement for its successor otherwise.
docs: setup
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

# The wheel is made from the sdist.
dist: setup
	rm -rf build dist *.egg-info
	$(BIN)/python -m build --no-isolation

# What a user's pip takes, without constraints.txt. The sdist goes into the same environment after the wheel: it has the
# same dependencies, which take minutes to install.
FRESH := build/fresh
check-dist: dist
	$(BIN)/twine check --strict dist/*
	rm -rf $(FRESH)
	$(PYTHON) -m venv $(FRESH)
	$(FRESH)/$(SCRIPTS)/pip install --quiet --disable-pip-version-check dist/*.whl
	cd build && fresh/$(SCRIPTS)/edge-depth-nerf --help >/dev/null && fresh/$(SCRIPTS)/edge-depth-nerf doctor
	cd build && fresh/$(SCRIPTS)/ns-train --help | grep edge-depth-nerf-lite >/dev/null
	cd build && fresh/$(SCRIPTS)/edge-depth-nerf inspect ../data/sample_drive --frames 1 --output inspection
	cd build && fresh/$(SCRIPTS)/edge-depth-nerf synthesize --output drive --frames 3 --size 48
	cd build && fresh/$(SCRIPTS)/edge-depth-nerf process kitti360 --root drive --sequence 2013_05_28_drive_0000_sync \
		--output scene --holdout-every 2 --no-estimate-depth
	$(FRESH)/$(SCRIPTS)/pip install --quiet --disable-pip-version-check --no-deps --force-reinstall dist/*.tar.gz
	cd build && fresh/$(SCRIPTS)/edge-depth-nerf --help >/dev/null && fresh/$(SCRIPTS)/edge-depth-nerf doctor
	rm -rf $(FRESH)

version:
	@$(PYTHON) -c 'import edge_depth_nerf; print(edge_depth_nerf.__version__)'

# The changelog's part on a version, for its release.
VERSION ?= $(shell $(PYTHON) -c 'import edge_depth_nerf; print(edge_depth_nerf.__version__)')
notes:
	@awk '/^## / { found = index($$0, "[$(VERSION)]"); next } found' CHANGELOG.md

clean:
	rm -rf build dist outputs site *.egg-info .pytest_cache .ruff_cache
