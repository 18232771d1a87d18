# Everything runs from a .venv that the first target makes; nothing outside this folder is changed.
PYTHON ?= $(shell command -v python3.11 || command -v python3)
VENV   := .venv
BIN    := $(VENV)/bin
READY  := $(VENV)/.roughmap-ready
UV     := $(BIN)/uv

.DEFAULT_GOAL := help
.PHONY: help setup demo test check audit bench bench-peers faults fuzz soak overload schemas lock image container-test clean

help:  ## this list
	@echo "make TARGET, where TARGET is:"
	@sed -n 's/^\([a-z-]*\):.*## \(.*\)/  \1|\2/p' $(MAKEFILE_LIST) | awk -F'|' '{printf "%-14s %s\n", $$1, $$2}'

setup: $(READY)  ## the Python environment, with the locked versions

# The stamp is made last, so that a setup which failed is tried again. Hatchling comes with the lock: the build looks nothing up.
$(READY): requirements.lock pyproject.toml
	@test -n "$(PYTHON)" && $(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' \
	  || { echo "roughmap needs Python 3.11 or newer: make PYTHON=/path/to/python3.11"; exit 1; }
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --require-hashes -r requirements.lock
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation -e .
	@touch $@

demo: $(READY)  ## the whole job in about a minute: service, rover, planner, replay, pictures in demo/
	$(BIN)/roughmap demo $(ARGS)

test: $(READY)  ## all tests, on two cores
	$(BIN)/python -m pytest -n 2 --dist loadfile $(ARGS)

check: $(READY)  ## style, types, the direction of imports, the exported schemas
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(BIN)/python -m roughmap_schemas.export --check

audit: $(READY)  ## unsafe habits (bandit), the lock's hashes, known faults of locked packages (it says so where none could be asked)
	$(BIN)/python -m pytest -q tests/security/test_audit.py
	$(BIN)/python .ci/audit

bench: $(READY)  ## what it costs, each figure with its mark and a reference beside it; pictures in bench/
	$(BIN)/python tests/bench/run.py $(ARGS)

bench-peers: $(READY)  ## nanoseconds a point beside what pip can bring, in an environment of its own
	$(BIN)/python tests/bench/peers.py $(ARGS)

faults: $(READY)  ## kills, power cuts, full disks, damage, bad links: what a service must survive; about 10 minutes
	$(BIN)/python tests/faults/run.py $(ARGS)

fuzz: $(READY)  ## any bytes to every reader of bytes, guided by coverage; ARGS="--seconds 600", findings in fuzz/
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --require-hashes -r tests/fuzz/requirements.txt || true
	$(BIN)/python tests/fuzz/run.py $(ARGS)

soak: $(READY)  ## an hour (ARGS="--minutes 15") of a fleet at work: what must stay flat does; picture and numbers in soak/
	$(BIN)/python tests/soak/soak.py $(ARGS)

overload: $(READY)  ## 10 minutes (ARGS="--minutes 3") of twice as many scans as can be integrated
	$(BIN)/python tests/soak/overload.py $(ARGS)

schemas: $(READY)  ## schemas/json anew from the models
	$(BIN)/python -m roughmap_schemas.export

lock:  ## requirements.lock anew from pyproject.toml
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	test -x $(UV) || $(BIN)/python -m pip install --quiet uv
	printf 'hatchling>=1.27\neditables>=0.5\n' | $(UV) pip compile pyproject.toml - --universal --python-version 3.11 --extra dev \
	  --no-strip-extras --generate-hashes --no-emit-index-url --quiet --custom-compile-command 'make lock' --output-file requirements.lock
	printf 'hatchling>=1.27\n' | $(UV) pip compile pyproject.toml - --universal --python-version 3.11 --constraint requirements.lock \
	  --no-strip-extras --generate-hashes --no-emit-index-url --quiet --custom-compile-command 'make lock' --output-file docker/requirements.lock

image:  ## the container image localhost/roughmap, by docker or podman (a machine that has neither: tests/containers/setup)
	docker/build $(ARGS)

container-test: $(READY) image  ## router, service and rover in containers: killed, paused, cut off, on a full volume; replayed
	$(BIN)/python tests/containers/run.py

clean:  ## what was built or made by running; not .venv, not logs of yours
	rm -rf build dist .pytest_cache .mypy_cache .ruff_cache .hypothesis .import_linter_cache .coverage
	find . -name __pycache__ -not -path './.venv/*' -prune -exec rm -rf {} +
