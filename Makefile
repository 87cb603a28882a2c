# Everything a person does here.  Each target makes its own environment in .venv from constraints.txt.
#   make demo                generate, train, evaluate, report: runs/demo/report.html
#   make demo MESHES=DIR     the same on a folder of .glb .gltf .obj .ply files: runs/demo-NAME/report.html
#   make table1              the paper's Table 1, every method trained and scored: runs/table1-tiny/table.md
#   make table1 DATA=DIR BUDGET=quick|tiny|paper TABLE1='--shown 20'    on your data, with more options
#   make bench               time the network beside a PyTorch twin: runs/bench/table.md (BENCH="--quick")
#   make test                the everyday suite
#   make test-ci             what takes minutes more: whole networks, experiments, wheel, notebooks, kills, many devices
#   make test-all            these, and what trains for minutes
#   make check               format, lint, types, tests
#   make docs                the documents as a site: site/index.html
#   make wheel               the package: dist/*.whl     make test-wheel   it alone in an empty environment
#   make fuzz                10,000 damaged files for every reader, and a table (FUZZ_INPUTS=500 FUZZ="-k glb")
#   make chaos               kill a training 100 times (CHAOS_KILLS=8 for 8 times)
#   make stability           float32 beside float64 for every kernel over its whole domain, and a table
#   make long-run            memory, pace and compilations of 2,000 training steps (LONG_RUN_STEPS=500)
#   make mutants             break the kernels on purpose; every fault has to be caught by the tests

PYTHON ?= python3.11
# XLA's false alarms about kept programs, as in spnr_jax/devices/runtime.py
export TF_CPP_MIN_LOG_LEVEL ?= 3
PY := .venv/bin/python
MESHES ?=
TEST_LIST ?=
OUT ?= runs/demo$(if $(MESHES),-$(notdir $(patsubst %/,%,$(MESHES))))
DEMO ?=
BENCH ?=
DATA ?=
BUDGET ?= tiny
TABLE1 ?=
FUZZ ?=

.PHONY: setup demo table1 bench test test-ci test-all test-wheel lint format types check docs wheel chaos fuzz stability long-run mutants clean

setup: .venv/complete

.venv/complete: pyproject.toml constraints.txt
	@test -x $(PY) || $(PYTHON) -m venv .venv; \
	echo "installing into .venv (about a minute)"; \
	$(PY) -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[train,data,viewer,formats,meshes,baselines,dev]' && \
	touch $@

demo: setup
	$(PY) -m experiments.packaged.demo --out $(OUT) $(if $(MESHES),--meshes $(MESHES)) $(if $(TEST_LIST),--test-list $(TEST_LIST)) $(DEMO)

table1: OUT = runs/table1-$(BUDGET)$(if $(DATA),-$(notdir $(patsubst %/,%,$(DATA))))
table1: setup
	$(if $(DATA),,$(PY) -m data_gen generate $(OUT)/data --objects 240 --spp 24 --visibility-grid 2 \
		--resolution $(if $(filter paper,$(BUDGET)),128,64))
	$(PY) -m experiments.paper.table1 --data $(or $(DATA),$(OUT)/data) --out $(OUT) --budget $(BUDGET) $(TABLE1)

bench: setup
	$(PY) -m experiments.speed.bench $(BENCH)

test: setup
	$(PY) -m pytest -q -rsfE -n 2 --dist loadfile --durations=25 -m "not slow and not ci"

# the longest files first, so that no worker is left with one of them at the end; files without such tests are not read
CI_FIRST := $(addprefix tests/,test_documents.py experiments/test_commands.py robustness/test_chaos.py test_wheel.py \
	robustness/test_many_devices.py laws/test_laws.py)
CI_FILES = $(CI_FIRST) $(filter-out $(CI_FIRST),$(shell grep -rl --include='test_*.py' 'mark\.ci' tests))

test-ci: setup
	$(PY) -m pytest -q -rsfE -n 2 --dist loadfile --no-loadscope-reorder -m "ci and not slow" $(CI_FILES)

test-all: setup
	$(PY) -m pytest -q -rsfE -n 2 --dist loadfile

test-wheel: setup
	$(PY) -m pytest -q tests/test_wheel.py

lint: setup
	$(PY) -m ruff check .
	$(PY) -m ruff format --check .
	$(dir $(PY))lint-imports --no-cache

format: setup
	$(PY) -m ruff check --fix .
	$(PY) -m ruff format .

types: setup
	$(PY) -m mypy spnr_jax data_gen experiments

check: lint types test

docs: .venv/docs
	NO_MKDOCS_2_WARNING=1 $(PY) -m mkdocs build --quiet --strict

.venv/docs: .venv/complete
	$(PY) -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[docs]' && touch $@

wheel: setup
	rm -rf build
	$(PY) -m pip wheel --quiet --disable-pip-version-check --no-deps -w dist .
	rm -rf build

fuzz: setup
	FUZZ_INPUTS=$(or $(FUZZ_INPUTS),10000) $(PY) -m pytest -q -s tests/robustness/test_fuzz.py -k "damaged and files" $(FUZZ)

chaos: setup
	CHAOS_KILLS=$(or $(CHAOS_KILLS),100) $(PY) -m pytest -q -s tests/robustness/test_chaos.py

stability: setup
	STABILITY=1 $(PY) -m pytest -q -s tests/laws/test_laws.py -k budget

long-run: setup
	LONG_RUN_STEPS=$(or $(LONG_RUN_STEPS),2000) $(PY) -m pytest -q -s tests/robustness/test_long_run.py

mutants: setup
	$(PY) tests/mutants.py

clean:
	rm -rf .venv build dist site *.egg-info
