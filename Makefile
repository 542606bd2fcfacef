# Two commands set everything up on a machine with Python >= 3.11, pip and make:
#   make paper    the paper's figures, tables and verdicts, in ./paper-out
#   make test     the tests
# PYTHON=python3.13 make test   takes another Python.

PYTHON ?= python3
VENV ?= .venv
OUT ?= paper-out
JOBS ?= 2
PART ?= 1
# Runs, files, gradients, implicit methods, command line, and each extra.
LOWEST = $(addprefix tests/test_,run.py integrate.py collocation.py solution_data.py cli.py fit_bayes.py \
  proof.py rings_files.py sweep_store.py sweep_cluster.py lanewise_elements.py) \
  $(wildcard tests/test_interop_*.py)
BIN = $(VENV)/bin
READY = $(VENV)/ready
SCHEMA = $(BIN)/check-jsonschema --quiet --builtin-schema vendor

export JAX_PLATFORMS ?= cpu

.PHONY: help paper notebooks docs dist lowest test test-all test-part test-fast lint types format lock clean

help:
	@sed -n 's/^## //p' $(MAKEFILE_LIST)

## make paper       reproduce the paper into ./paper-out (OUT=... for another new directory)
paper: $(READY)
	$(BIN)/dvi-jax paper --out $(OUT)

## make notebooks   execute the notebooks again (NOTEBOOKS=--check to compare, or names of some)
notebooks: $(READY)
	$(BIN)/python notebooks/make.py $(NOTEBOOKS)

## make docs        the documentation, as pages in docs/_build/html
docs: $(READY)
	$(BIN)/python -m sphinx -W --keep-going -q -j auto -b html docs docs/_build/html
	@echo "open docs/_build/html/index.html"

## make dist        source archive and wheel in ./dist; the README's code runs where only the wheel is
dist: $(READY)
	rm -rf dist
	$(BIN)/uv build -q --no-build-isolation --python $(BIN)/python --out-dir dist
	$(BIN)/twine check --strict dist/*.whl dist/*.tar.gz
	test $$(tar tzf dist/*.tar.gz | grep -c -E '/(Makefile|requirements.lock.txt)$$') = 2
	$(BIN)/uv venv -q --python $(BIN)/python dist/venv
	$(BIN)/uv pip install -q --python dist/venv/bin/python --constraint requirements.lock.txt dist/*.whl
	sed -n '/^```python$$/,/^```$$/{/^```/!p}' README.md > dist/readme.py
	cd dist && MPLBACKEND=Agg venv/bin/python -P readme.py

## make lowest      quick tests with the lowest versions that pyproject.toml allows (Python 3.11)
lowest: $(READY)
	rm -rf build/lowest
	$(BIN)/uv venv -q --python $(BIN)/python build/lowest
	$(BIN)/uv pip install -q --python build/lowest/bin/python --resolution lowest-direct \
	  -e ".[test,ephemeris]"
	build/lowest/bin/python -m pytest -q -n $(JOBS) --dist loadfile $(LOWEST)

## make test        every part of the package at least once, in about eight minutes
test: $(READY)
	$(BIN)/python -m pytest -n $(JOBS) --dist loadfile --durations=20

## make test-all    all tests, long ones included
test-all: $(READY)
	$(BIN)/python -m pytest -n $(JOBS) --dist loadfile -m "slow or not slow" --durations=40

## make test-part   one of four parts of the long tests (PART=1 to 4)
test-part: $(READY)
	$(BIN)/python -m pytest -n $(JOBS) --dist loadfile -m slow --part $(PART)/4 --durations=20

test-fast: test

## make lint        style, formatting, and the files that other services read
lint: $(READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/python packaging/release.py
	$(BIN)/validate-pyproject pyproject.toml
	$(SCHEMA).github-workflows .github/workflows/*.yml
	$(SCHEMA).github-issue-forms $(filter-out %/config.yml,$(wildcard .github/ISSUE_TEMPLATE/*.yml))
	$(SCHEMA).github-issue-config .github/ISSUE_TEMPLATE/config.yml
	$(SCHEMA).dependabot .github/dependabot.yml
	$(SCHEMA).readthedocs .readthedocs.yaml
	$(SCHEMA).citation-file-format CITATION.cff
	$(BIN)/zizmor --quiet --offline --min-severity medium .github
	! command -v actionlint >/dev/null || actionlint

## make types       static types
types: $(READY)
	$(BIN)/pyright --pythonpath $(BIN)/python

## make format      format the code with ruff
format: $(READY)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

## make lock        renew requirements.lock.txt from pyproject.toml
lock: $(READY)
	$(BIN)/uv pip compile pyproject.toml --universal --generate-hashes --upgrade \
	  --extra ephemeris --extra test --group dev --no-emit-index-url --no-annotate \
	  --custom-compile-command "make lock" --quiet --output-file requirements.lock.txt

# The environment, made without ensurepip (Debian's python3 has none) from hashed requirements.
$(READY): requirements.lock.txt pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { \
	  echo "dvi_jax needs Python >= 3.11; '$(PYTHON)' is $$($(PYTHON) --version 2>&1)."; \
	  echo "Name another one: PYTHON=python3.12 make $(MAKECMDGOALS)"; exit 1; }
	rm -rf $(VENV)
	$(PYTHON) -m venv --without-pip $(VENV)
	$(PYTHON) -m pip --python $(BIN)/python install --quiet --disable-pip-version-check \
	  --require-hashes --requirement requirements.lock.txt
	$(PYTHON) -m pip --python $(BIN)/python install --quiet --disable-pip-version-check \
	  --no-deps --no-build-isolation --editable .
	touch $(READY)

## make clean       remove the environment and what tools left behind
clean:
	rm -rf $(VENV) .pytest_cache .ruff_cache .hypothesis build dist
