# make table1   the environment, then Table 1 of the paper at the default scale
# make demo     the environment, then one small scene from nothing to a film and a viewer: minutes
# make test     the tests (make test-all adds the slow ones)
# make env      the environment alone        make lint    style, types and import contracts
# make coverage the fast unit tests with the coverage of neuma_lib and of its public functions
# make capture  the environment, with OpenCV, COLMAP and MeshLab for own photographs and videos (docs/capture.md)
# make viewer   the environment, with viser for the viewer in a browser (docs/viewer.md)
# make engines  the environment, with newton, MuJoCo and scikit-fem (docs/engines.md)
# make docs-env the environment, with mkdocs for the site
# make test-core  build the package, install it without extras in a fresh environment, run the tests marked `core` there
# make lock     write envs/ from pyproject.toml and envs/pins.txt
# make unlock   after a killed Snakemake     make clean   everything computed, but not the environment

PYTHON ?= python3.11
VENV ?= .venv
CORES ?= 2
BIN := $(VENV)/bin
INSTALL := $(BIN)/python -m pip install --quiet --disable-pip-version-check
READY := $(VENV)/.ready
SNAKEMAKE := $(BIN)/snakemake --cores $(CORES)

.PHONY: table1 demo all dataset test test-all test-core coverage lint env capture viewer engines docs-env check unlock lock clean

table1: env unlock
	$(SNAKEMAKE) results/table1.csv

demo: env unlock
	$(SNAKEMAKE) --configfile config/demo.yaml -- demo
	@echo "Now open $(CURDIR)/results/demo/SoftDuck/viewer.html in a browser; film and numbers: results/demo/demo.md"

# The film of the README.
docs/learned.gif: demo
	cp results/demo/SoftDuck/film.gif $@

all dataset: env unlock
	$(SNAKEMAKE) $@

test: env
	$(BIN)/python -m pytest -m "not slow" -n $(CORES)

test-all: env
	$(BIN)/python -m pytest -n $(CORES)

coverage: env
	$(BIN)/python -m pytest -m "not slow" -n $(CORES) --ignore=tests/workflow --cov=neuma_lib \
	  --cov-report=json:coverage.json --cov-report=term:skip-covered
	$(BIN)/python -m tests.support.public_coverage coverage.json

# In a fresh environment; VERSIONS=lowest takes the lower bounds of pyproject.toml.
VERSIONS ?= newest
test-core:
	PYTHON=$(PYTHON) tests/core_install.sh .core/$(VERSIONS) $(VERSIONS)

lint: env
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/snakefmt --check Snakefile studies workflow
	$(BIN)/lint-imports --no-cache
	$(BIN)/pyright --pythonpath $(BIN)/python
	$(BIN)/snakemake --lint

# A killed Snakemake leaves its lock behind.
unlock: env
	@$(BIN)/python -m workflow.unlock

env: $(READY)

capture: env envs/requirements-capture.txt
	$(INSTALL) -r envs/requirements-capture.txt

viewer: env envs/requirements-viewer.txt
	$(INSTALL) -r envs/requirements-viewer.txt

engines: env envs/requirements-engines.txt
	$(INSTALL) -r envs/requirements-engines.txt

docs-env: env envs/requirements-docs.txt
	$(INSTALL) -r envs/requirements-docs.txt

$(READY): envs/requirements.txt envs/requirements-dev.txt pyproject.toml
	@command -v $(PYTHON) >/dev/null 2>&1 && $(PYTHON) -c 'import sys; sys.exit(sys.version_info[:2] != (3, 11))' || { \
	  echo "Python 3.11 is needed (Blender's module bpy 4.5 has no other), and '$(PYTHON)' is not one." >&2; \
	  echo "Debian 12: apt-get install python3.11 python3.11-venv   elsewhere: pyenv install 3.11, or conda create -n neuma python=3.11" >&2; \
	  echo "Then: make PYTHON=/path/to/python3.11 ..." >&2; exit 1; }
	@$(PYTHON) -c 'import ensurepip, venv' 2>/dev/null || { \
	  echo "Python's venv module is missing: apt-get install python3.11-venv" >&2; exit 1; }
	$(PYTHON) -m venv $(VENV)
	$(INSTALL) -r envs/requirements-dev.txt
	$(INSTALL) --no-deps --no-build-isolation --editable .
	@$(MAKE) --no-print-directory check
	@touch $(READY)

check:
	@$(BIN)/python -m neuma_lib.data.blender.libraries

lock: envs/lock.py pyproject.toml envs/pins.txt
	$(BIN)/python envs/lock.py $(UPGRADE)

clean:
	rm -rf data results .cache .snakemake .pytest_cache .ruff_cache .coverage coverage.json
