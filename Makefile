# Every target does its own set-up: `make test` on a fresh clone is enough.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready

# nerfstudio asks for nerfacc 0.5.2; tests run with this one too, from a folder of its own.
NERFACC := nerfacc==0.5.3

# Other targets' arguments: make test PYTEST='-k gate', make demo DEMO='--out runs/other'
PYTEST ?=
DEMO ?=

# Tests start processes that import the package: its bytecode is kept, whatever the environment says.
# One torch thread a worker: small tensors gain nothing by more, and two workers fill two cores.
WORKERS ?= 2

.PHONY: demo test lint format docs env dist clean

demo: $(READY)
	$(BIN)/leco demo $(DEMO)

# What is left says whether benchmarks call the package as it is.
NOT_IN_BENCHMARKS := arg-type assignment attr-defined import-not-found index list-item method-assign misc \
	type-abstract union-attr var-annotated

test: $(READY)
	OMP_NUM_THREADS=1 PYTHONDONTWRITEBYTECODE= $(BIN)/python -m pytest --numprocesses $(WORKERS) --dist loadgroup --durations 40 $(PYTEST)

lint: $(READY)
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	MYPYPATH=benchmarks $(BIN)/mypy $(NOT_IN_BENCHMARKS:%=--disable-error-code=%) benchmarks/*.py

format: $(READY)
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

# The pages of docs/ as a site in site/, which opens without a server. A broken link is an error.
docs: $(READY)
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --quiet --strict
	@echo "open site/index.html"

env: $(READY)
	@echo "ready; now type: source $(BIN)/activate"

# The wheel is built from the sdist, then installed and tried in an environment of its own.
dist: $(READY)
	rm -rf dist
	$(BIN)/python -m build
	PYTHON=$(BIN)/python .ci/clean-install "$$($(BIN)/python -c 'import sysconfig; print(sysconfig.get_path("purelib"))')"

# Entry points and requirements stand in pyproject.toml, so the installation is as old as it is.
$(READY): pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 10))' || \
		{ echo "leco_plugin needs Python 3.10 or newer; try: make PYTHON=python3.11" >&2; exit 2; }
	@test -x $(BIN)/python || $(PYTHON) -m venv $(VENV) || \
		{ echo "no virtual environment can be made; on Debian: apt-get install python3-venv" >&2; exit 2; }
	@echo "filling $(VENV): about three minutes and 8 GB, most of it torch"
	$(BIN)/python -m pip install --disable-pip-version-check --editable '.[dev]'
	$(BIN)/python -m pip install --disable-pip-version-check --no-deps --upgrade \
		--target $(VENV)/$(subst ==,-,$(NERFACC)) $(NERFACC)
	@touch $@

clean:
	rm -rf $(VENV) site
