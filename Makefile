# Everything a person does here.  Each target makes its own environment in .venv from constraints.txt.
#   make demo                generate, train, evaluate, report: runs/demo/report.html
#   make demo MESHES=DIR     the same on a folder of .glb .gltf .obj .ply files: runs/demo-NAME/report.html
#   make test                the everyday suite      make test-all   with the slow tests
#   make check               format, lint, types, tests
#   make mutants             break the kernels on purpose; every fault has to be caught by the tests

PYTHON ?= python3.11
PY := .venv/bin/python
MESHES ?=
TEST_LIST ?=
OUT ?= runs/demo$(if $(MESHES),-$(notdir $(patsubst %/,%,$(MESHES))))
DEMO ?=

.PHONY: setup demo test test-all lint format types check mutants clean

setup: .venv/complete

.venv/complete: pyproject.toml constraints.txt
	@begin=$$(date +%s); \
	test -x $(PY) || $(PYTHON) -m venv .venv; \
	echo "installing into .venv (about a minute)"; \
	$(PY) -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[data,dev]' && \
	echo $$(( $$(date +%s) - begin )) > .venv/install_seconds && touch $@

demo: setup
	$(PY) -m experiments.demo --out $(OUT) $(if $(MESHES),--meshes $(MESHES)) $(if $(TEST_LIST),--test-list $(TEST_LIST)) $(DEMO)

test: setup
	$(PY) -m pytest -q -n 2 --dist loadfile -m "not slow"

test-all: setup
	$(PY) -m pytest -q -n 2 --dist loadfile

lint: setup
	$(PY) -m ruff check .
	$(PY) -m ruff format --check .

format: setup
	$(PY) -m ruff check --fix .
	$(PY) -m ruff format .

types: setup
	$(PY) -m mypy spnr_jax data_gen experiments

check: lint types test

mutants: setup
	$(PY) tests/mutants.py

clean:
	rm -rf .venv build dist *.egg-info
