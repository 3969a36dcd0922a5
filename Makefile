# Two commands on a fresh machine: `make dataset` and `make test`. Both do all the set-up themselves.
# Prerequisites: python3 (3.11 or later) with venv, make, git.
# WITHOUT_GPL=1 leaves out what is under the GPL: pymeshlab, and parts of libigl that nobody calls.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
export PATH := $(abspath $(BIN)):$(PATH)
export PIP_DISABLE_PIP_VERSION_CHECK := 1
export PYTHONDONTWRITEBYTECODE :=  # hundreds of processes would each compile 300 modules anew

.PHONY: help setup setup-all dataset test test-slow test-elsewhere train release serve stop lint lock docs clean

# of a target that was asked for by name, not of one that others need
READY = $(if $(filter $@,$(or $(MAKECMDGOALS),setup)),@echo 'Installed into $(VENV). Next: . $(BIN)/activate && $(1)')

setup: $(VENV)/.dataset-ready  ## what making data needs
	$(call READY,make dataset)

setup-all: $(VENV)/.all-ready  ## that, torch, and the tools of the tests
	$(call READY,make dataset train)

help:  ## these lines
	@sed -nE 's/^([a-z-]+):.*## /\1\t/p' $(MAKEFILE_LIST) | awk -F '\t' '{ printf "make %-16s %s\n", $$1, $$2 }'

SCENES := 24

dataset: setup  ## scenes of built-in objects, verified: 24, or SCENES=N
	trilight generate tiny --objects procedural: --out data/smoke --scenes $(SCENES)
	trilight verify data/smoke

# three workers on two cores: some of the time is waiting, and each worker imports all tests
test: setup-all  ## the quick tests, in five minutes on two cores
	OMP_NUM_THREADS=1 OMP_WAIT_POLICY=PASSIVE python -m pytest -n 3 --dist worksteal

# only files that have one are looked through: each worker imports all that it looks through
# Blender, which some compare with, goes into the user's cache once: 380 MB
test-slow: setup-all  ## the others, of the kinds in tests/conftest.py, in half an hour
	$(if $(WITHOUT_GPL),,python -c 'import infra.bench.workloads.cycles as e; e.blender_python()' || echo Tests beside Blender skip.)
	python -m pytest -m slow -n 3 --dist loadfile --no-loadscope-reorder $$(grep -rl --include='test_*.py' 'mark\.slow' tests)

test-elsewhere: setup-all  ## the most telling ones, as other processors would run them
	python -m tests.elsewhere

train: setup-all  ## the smoke model on what `make dataset` made
	trilight train tiny --data data/smoke --out runs/smoke $(if $(wildcard runs/smoke/checkpoints/*),--resume)

RELEASE := data/release
RELEASE_SCENES := 1024
RELEASE_PIXELS := 128
RELEASE_SHARD := 32

# beside them: the bill of materials and the licenses of what is installed
release: setup-all  ## dataset, network and pictures to publish, in $(RELEASE); an hour or two of two cores, goes on where it stopped
	trilight generate tiny --objects procedural: --out '$(RELEASE)/dataset' --scenes $(RELEASE_SCENES) --resolution $(RELEASE_PIXELS) \
		--set splits.scenes_per_shard=$(RELEASE_SHARD) --set 'storage.passes=[depth,normal,object]'
	python -m infra.release '$(RELEASE)'
	cyclonedx-py environment --output-reproducible --of JSON -o '$(RELEASE)/sbom.cdx.json'
	pip-licenses --from=mixed --with-urls --format=markdown --output-file='$(RELEASE)/third-party.md'

serve: setup  ## Prefect's server, a pool, a worker and the flows as deployments, on this machine
	python -m infra.serving.local start

stop:  ## end exactly what `make serve` started
	python -m infra.serving.local stop

lint: setup-all  ## format, style, types, layers
	ruff format --check .
	ruff check .
	mypy
	lint-imports

lock: setup-all  ## write the lock files anew from requirements/*.in
	infra/setup/lock.sh

docs: $(VENV)/.docs-ready  ## the documentation as a site that opens from disk: site/index.html
	mkdocs build --strict --quiet

clean:  ## everything that make has made, except data/ and runs/
	rm -rf $(VENV) .pytest_cache .mypy_cache .ruff_cache .import_linter_cache *.egg-info site

$(VENV)/.dataset-ready: requirements/dataset.txt requirements/build.txt pyproject.toml infra/setup/install.sh
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	infra/setup/install.sh $(BIN)/python dataset
	$(if $(WITHOUT_GPL),infra/setup/without_gpl.sh $(BIN)/python)
	$(BIN)/python -m pip install --quiet --no-deps --no-build-isolation --editable .
	touch $@

$(VENV)/.all-ready: requirements/all.txt requirements/cuda.txt $(VENV)/.dataset-ready
	infra/setup/install.sh $(BIN)/python all
	$(if $(WITHOUT_GPL),infra/setup/without_gpl.sh $(BIN)/python)
	touch $@

$(VENV)/.docs-ready: requirements/docs.txt $(VENV)/.dataset-ready
	infra/setup/install.sh $(BIN)/python docs
	touch $@
