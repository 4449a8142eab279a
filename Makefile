# Targets of rcg_jax; "make" lists them. All of them work in .venv, made from the committed lock.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
ARGS ?=
BUDGET ?= cpu
# Tests side by side, those of a file in one process: they share what it compiled. WORKERS= runs them one by one.
WORKERS ?= -n auto --maxprocesses 4 --dist loadfile --no-loadscope-reorder

.DEFAULT_GOAL := help
.PHONY: help venv run demo test test-fast bench scaling gpu race race-env figures reproduce docs lint type format apt lock clean

help:  ## list the targets
	@awk 'BEGIN {FS = ":.*## "} /^[a-z-]+:.*## / {printf "  make %-12s %s\n", $$1, $$2}' $(MAKEFILE_LIST)

venv: $(STAMP)  ## create .venv from the lock

$(STAMP): requirements.lock pyproject.toml
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "rcg_jax needs Python >= 3.11, this is " + sys.version)'
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV) || { echo "no venv module: on Debian and Ubuntu, make apt" >&2; exit 1; }
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -r requirements.lock
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --editable .
	touch $@

run: $(STAMP)  ## train ring_peg (ARGS="engine=native seed=1" changes settings)
	$(BIN)/python -m rcg_jax.run task=ring_peg $(ARGS)

demo: $(STAMP)  ## a few minutes on 2 cores: watch ring_peg learn, with pictures at the end
	$(BIN)/python -m rcg_jax.run task=ring_peg run_dir=runs/demo iterations=80 eval_every=10 $(ARGS)

test: $(STAMP)  ## all tests
	$(BIN)/python -m pytest $(WORKERS)

test-fast: $(STAMP)  ## tests without the slow ones
	$(BIN)/python -m pytest $(WORKERS) -m "not slow"

bench: $(STAMP)  ## measure throughput, start-up and memory as ratios; writes experiments/results/bench.csv
	$(BIN)/python -m experiments.benchmarks.bench $(ARGS)

scaling: $(STAMP)  ## speed, memory and compilation over environments, seeds, devices, engines, tasks (docs/performance.md)
	$(BIN)/python -m experiments.benchmarks.scaling $(ARGS)

gpu: $(STAMP)  ## ten minutes on an NVIDIA GPU: scaling, seeds, agreement with the CPU, bench
	PYTHON=$(BIN)/python experiments/benchmarks/gpu.sh $(ARGS)

race: $(STAMP) race-env  ## minutes to a solved task, beside Stable-Baselines3, sbx and Brax (docs/race.md); hours
	$(BIN)/python -m experiments.race $(ARGS)

race-env: .venv-race/.installed  ## the environment of the race's rivals, .venv-race

.venv-race/.installed: requirements.lock requirements-race.txt
	test -x .venv-race/bin/python || $(PYTHON) -m venv .venv-race
	.venv-race/bin/python -m pip install --quiet --disable-pip-version-check -r requirements.lock -r requirements-race.txt
	.venv-race/bin/python -m pip install --quiet --disable-pip-version-check --no-deps --editable .
	touch $@

figures: $(STAMP)  ## all figures and tables of the paper from the committed CSV files (ARGS="only=fig2")
	$(BIN)/python -m experiments.paper.figures $(ARGS)

reproduce: $(STAMP)  ## train what the figures need, BUDGET=cpu or gpu (docs/reproduce.md; ARGS="plan=table" shows it)
	$(BIN)/python -m experiments.paper.reproduce budget=$(BUDGET) $(ARGS)

docs: $(STAMP)  ## build the documentation site into site/; warnings are errors
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet

lint: $(STAMP)  ## ruff
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

type: $(STAMP)  ## mypy
	$(BIN)/mypy

format: $(STAMP)  ## format the code
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

apt:  ## Debian/Ubuntu packages for venv, headless rendering, tests of the report (skippable: what lacks them says so)
	apt-get update && apt-get install -y --no-install-recommends python3-venv libegl1 libegl-mesa0 libgl1-mesa-dri
	@# Ubuntu has Chromium as a snap only; without it the tests of the report in a browser are skipped.
	apt-get install -y --no-install-recommends chromium chromium-driver || true

lock: $(STAMP)  ## renew requirements.lock from pyproject.toml
	$(BIN)/python -m pip install --quiet uv
	printf 'jax==0.10.1\njaxlib==0.10.1\n' > $(VENV)/constraints.txt
	$(BIN)/uv pip compile --quiet --universal --python-version 3.11 --no-emit-index-url --no-header --extra dev --extra docs -c $(VENV)/constraints.txt pyproject.toml -o requirements.lock

clean:  ## remove .venv and caches, keep runs
	rm -rf $(VENV) .pytest_cache .ruff_cache .mypy_cache build dist *.egg-info
