# make demo   install what it needs, simulate a traverse, run the real graph over DDS on it, write results/latest
# make test   the whole test suite
# make test-jazzy   the suite with the versions of an installed Jazzy (NumPy 1.26.4), in a separate venv
# make check   lint and the fast tests, about two minutes
# make lint   ruff, mypy, codespell, the import contracts, the rules of prose and the limits of structure
# make wheel  a wheel with the compiled part, in dist
# make bench   CPU per scan of a replay and its parts
# make docs   the documentation as a site, build/site
.PHONY: demo test check test-jazzy lint bench docs wheel install install-dev clean
SHELL := /bin/bash

VENV ?= .venv
SEED ?= 1
DEMO ?=
# index of the CPU builds of torch; plain "torch" would install CUDA builds of some gigabytes
TORCH_INDEX ?= https://download.pytorch.org/whl/cpu
PYTHON ?= $(shell for p in python3.12 python3.11 python3; do $$p -c 'import sys; sys.exit(not (3,11) <= sys.version_info[:2] <= (3,12))' 2>/dev/null && echo $$p && break; done)
BIN := $(VENV)/bin
# commands start in half of the time where Python may keep compiled modules
export PYTHONDONTWRITEBYTECODE :=
# test files in parallel, each worker with one thread; one more than cores, for tests of nodes mostly wait
JOBS ?= $(shell cores=$$(getconf _NPROCESSORS_ONLN); echo $$((cores < 4 ? cores + 1 : 5)))
# twice quiet: errors alone; compiled when they are imported, most modules never
PIP := -m pip install --quiet --quiet --disable-pip-version-check --no-compile --use-pep517
PYTEST := -m pytest -n $(JOBS) --dist loadfile --no-loadscope-reorder

demo: install
	@$(BIN)/umf demo --seed $(SEED) $(DEMO)

test: install-dev
	@OMP_NUM_THREADS=1 $(BIN)/python $(PYTEST)

# without slow tests and tests that start nodes, a browser or a database server
check: lint
	@OMP_NUM_THREADS=1 $(BIN)/python $(PYTEST) -m "not (slow or ros or browser or postgres)"

test-jazzy: .venv-jazzy/.installed
	@OMP_NUM_THREADS=1 .venv-jazzy/bin/python $(PYTEST)

# all packages that tests import except the Rerun viewer, which needs NumPy 2
.venv-jazzy/.installed: $(wildcard requirements*.txt) package.xml setup.py setup.cfg pyproject.toml $(wildcard umf_ros/scan/kernels/*)
	@test -n "$(PYTHON)" || { echo "make: Python 3.11 or 3.12 is needed (set PYTHON=...)" >&2; exit 1; }
	@PYTHON=$(PYTHON) ./tools/system_packages.sh
	@test -x .venv-jazzy/bin/python || $(PYTHON) -m venv .venv-jazzy
	@grep -hv '^-r' requirements-demo.txt requirements-dev.txt requirements-lab.txt requirements-fleet.txt \
		> .venv-jazzy/tools.txt
	@./tools/install_torch.sh .venv-jazzy/bin/python $(TORCH_INDEX)
	@.venv-jazzy/bin/python $(PIP) -r requirements-jazzy.txt -r requirements-ros.txt -r .venv-jazzy/tools.txt
	@.venv-jazzy/bin/python $(PIP) --no-deps --no-build-isolation --editable .
	@touch $@

lint: install-dev
	@$(BIN)/ruff check .
	@$(BIN)/ruff format --check .
	@$(BIN)/mypy
	@$(BIN)/lint-imports --no-logo
	@$(BIN)/codespell
	@$(BIN)/python tools/style_check.py
	@$(BIN)/python tools/structure_figures.py --check

bench: install
	@$(BIN)/python benchmarks/scale/cpu.py

# every page and every link, as a site in build/site
docs: export REPOSITORY_URL ?= $(shell git remote get-url origin 2>/dev/null | sed -n 's,^git@\([^:]*\):,https://\1/,; s,\.git$$,,; /^https*:/p')
docs: install-dev
	@$(BIN)/python tools/parameters_doc.py --check
	@NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --quiet --strict

# in build/wheel first: in dist there may be others
wheel: install
	@rm -rf build/wheel
	@$(BIN)/python -m pip wheel --quiet --quiet --disable-pip-version-check --no-deps --no-build-isolation --wheel-dir build/wheel .
	@mkdir -p dist && mv build/wheel/*.whl dist && ls dist/umf_ros-*.whl

install: $(VENV)/.installed
install-dev: $(VENV)/.installed-dev

# requirements in a separate step: they change rarely and take most of the time
$(VENV)/.installed: $(wildcard requirements*.txt) package.xml setup.py setup.cfg pyproject.toml $(wildcard umf_ros/scan/kernels/*)
	@test -n "$(PYTHON)" || { echo "make: Python 3.11 or 3.12 is needed (set PYTHON=...)" >&2; exit 1; }
	@PYTHON=$(PYTHON) ./tools/system_packages.sh
	@test -x $(BIN)/python || { echo "Making $(VENV) with $$($(PYTHON) --version)"; $(PYTHON) -m venv $(VENV); }
	@echo "Installing the requirements, with Open3D for the simulator (one to three minutes the first time)"
	@$(BIN)/python $(PIP) -r requirements-demo.txt
	@$(BIN)/python $(PIP) --no-deps --no-build-isolation --editable .
	@touch $@

$(VENV)/.installed-dev: $(VENV)/.installed
	@./tools/install_torch.sh $(BIN)/python $(TORCH_INDEX)
	@echo "Installing torch, Ray, PostgreSQL, Rerun and the tools of tests and documentation (some minutes the first time)"
	@$(BIN)/python $(PIP) -r requirements-dev.txt
	@touch $@

clean:
	rm -rf build dist install log results data *.egg-info
