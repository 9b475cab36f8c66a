# Verbs only. Everything runs in .venv, which set-up makes and keeps to requirements.lock.
.DEFAULT_GOAL := help
SHELL := /bin/bash
PY := .venv/bin/python
STAGES := $(shell sed -n '/^stages:/,$$s/^  \([a-z_]*\):.*/\1/p' pipeline.yaml)
OPTIONS = $(if $(DATASET),--dataset "$(DATASET)") $(if $(SET),--set "$(SET)") $(if $(filter-out 0,$(FORCE)),--force)
OPTIONS_NOT_FORCED = $(if $(DATASET),--dataset "$(DATASET)") $(if $(SET),--set "$(SET)")
MAKEFLAGS += --no-print-directory
unexport DATASET SET FORCE

.PHONY: all plan why status graph validate verify clean gc setup test test-long data help $(STAGES)

all plan why $(STAGES): .venv/ready
	@$(PY) -m factorlib $@ $(OPTIONS)

status validate: .venv/ready
	@$(PY) -m factorlib $@ $(OPTIONS_NOT_FORCED)

graph gc: .venv/ready
	@$(PY) -m factorlib $@

clean verify: .venv/ready
	@$(PY) -m factorlib $@ $(if $(DATASET),--dataset "$(DATASET)")

setup: .venv/ready
	@:

.venv/ready: requirements.lock factorlib/setup.py
	@for python in $(PYTHON) python3.11 python3.12 python3; do \
	  $$python -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null && exec $$python -I factorlib/setup.py; \
	done; echo "set-up: no Python 3.11 or 3.12 was found; install one, or name it: make PYTHON=/path/to/python3.11" >&2; exit 1

test: .venv/ready
	@$(PY) -m ruff check --no-cache
	@.venv/bin/lint-imports --no-cache
	@OMP_NUM_THREADS=1 PYTHONDONTWRITEBYTECODE=1 $(PY) -m pytest -n 2 -p no:cacheprovider

test-long: .venv/ready
	@OMP_NUM_THREADS=1 PYTHONDONTWRITEBYTECODE=1 $(PY) -m pytest -n 2 -p no:cacheprovider -m long

bench-%: .venv/ready
	@OMP_NUM_THREADS=1 $(PY) -m benchmarks.$*

data: .venv/ready
	@$(PY) -m factorlib.generate synthetic
	@$(PY) -m factorlib.generate eames

help:
	@echo 'make all DATASET=eames               the whole pipeline; DATASET is a name in data/ or a path to a folder'
	@echo 'make <stage> DATASET=…               one stage and what it needs: $(STAGES)'
	@echo '     SET="solve.lobes=64 …"          with other parameters      FORCE=1   run again, whatever is there'
	@echo 'make fit_mesh | refine DATASET=…      only when asked for: proportions of meshes, poses by shading; SET="align.poses=build/…/refine" uses them'
	@echo 'make plan | why | status DATASET=…   what would run; why; how far each stage is'
	@echo 'make validate DATASET=…              look at every file of a dataset, without running anything'
	@echo 'make graph                           the stages and what they take'
	@echo 'make verify [DATASET=…]              read every kept result and name what is damaged (FORCE=1 replaces it, whatever it is)'
	@echo 'make clean [DATASET=…]               delete the results of a dataset, or of all'
	@echo 'make gc                              delete results that no dataset names any more'
	@echo 'make test                            lint, layers, tests'
	@echo 'make test-long                       the tests that take long, which make test leaves out'
	@echo 'make bench-operator                  time, error and looks of the reflection operators, to build/bench/operator'
	@echo 'make bench-solve                     the joint solve: speed against error, to build/bench/solve'
	@echo 'make bench-parts DATASETS="…"        what each part of the model is worth on data sets, to build/bench/parts'
	@echo 'make bench-align                     time, success and error of poses against rendered truth, to build/bench/align'
	@echo 'make data                            make data/ again'
	@echo 'make setup                           only the environment (TORCH_INDEX=<url> for another PyTorch)'

.DEFAULT:
	@test -e .venv/ready || $(MAKE) setup
	@$(PY) -m factorlib $@ $(OPTIONS)

Makefile pipeline.yaml requirements.lock factorlib/setup.py: ;
