# Verbs only. Everything runs in .venv, which set-up makes and keeps to requirements.lock.
.DEFAULT_GOAL := help
# What is given as NAME=value goes to programs through the environment, as it was written: make would expand a `$` in it
# wherever it exports or mentions the variable, and a shell its quotes and backticks.  First of all, before any $(shell …).
$(foreach name,$(.VARIABLES),$(if $(filter command line,$(origin $(name))),$(eval override $(name) := $$(value $(name)))$(eval export $(name))))
override export GOAL = $@
SHELL := /bin/bash
# Containers often set it; every process would then compile what it imports.
unexport PYTHONDONTWRITEBYTECODE
override PY := .venv/bin/python
override STAGES := $(shell sed -n '/^stages:/,$$s/^  \([a-z_]*\):.*/\1/p' pipeline.yaml)
MAKEFLAGS += --no-print-directory

.PHONY: all plan why status params new photos label validate verify clean setup lock test check-types run-tests test-long docs results study studies data help help-all $(STAGES)

# each reads DATASET, SET, HELD_OUT and FORCE from the environment
all plan why status params new photos label validate verify $(STAGES): .venv/ready
	@$(PY) -m factorlib "$$GOAL"

clean: .venv/ready
	@[ -z "$$STUDY" ] || { echo "error: STUDY: clean deletes results of datasets; those of studies: rm -r build/studies" >&2; exit 1; }
	@$(PY) -m factorlib clean

setup: .venv/ready
	@[ -z "$$EXTRAS" ] || $(PY) -I factorlib/setup.py extras

.venv/ready: requirements.lock factorlib/setup.py
	@for python in $${PYTHON:+"$$PYTHON"} python3.11 python3.12 python3; do \
	  "$$python" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null && exec "$$python" -I factorlib/setup.py; \
	done; echo "set-up: no Python 3.11 or 3.12 was found; install one, or name it: make PYTHON=/path/to/python3.11" >&2; exit 1

lock: .venv/ready
	@$(PY) -I factorlib/setup.py lock

test: .venv/ready
	@$(PY) -m ruff check --no-cache && $(PY) -m ruff format --check --no-cache --quiet
	@.venv/bin/lint-imports --no-cache
	@$(MAKE) -j 2 check-types run-tests

# beside the tests, since it takes one core
check-types: .venv/ready
	@$(PY) -m mypy

run-tests: .venv/ready
	@OMP_NUM_THREADS=1 env -u DATASET -u SET -u HELD_OUT -u FORCE $(PY) -m pytest -n 2 --dist worksteal -p no:cacheprovider

test-long: .venv/ready
	@OMP_NUM_THREADS=1 $(PY) -m pytest -n 2 --dist worksteal -p no:cacheprovider -m long

docs: .venv/ready
	@test -x .venv/bin/mkdocs || EXTRAS=docs $(PY) -I factorlib/setup.py extras
	@NO_MKDOCS_2_WARNING=1 .venv/bin/mkdocs build -q --strict && echo 'build/docs/index.html'

# reads ONLY, LIGHTS and REAL from the environment
results: .venv/ready
	@OMP_NUM_THREADS=1 $(PY) -m studies.measured.results

# each reads STUDY, QUICK and FORCE from the environment
study: .venv/ready
	@$(PY) -m studies --one

studies: .venv/ready
	@$(PY) -m studies

data: .venv/ready
	@$(PY) -m factorlib.generate synthetic
	@$(PY) -m factorlib.generate eames

help:
	@echo 'make all DATASET=eames                     start here: run the example; it ends by naming the report to open'
	@echo 'make render DATASET=eames RECIPE=insert    then a picture of the result: a ball in every photo (docs/recipes.md)'
	@echo 'make photos DATASET=mychair PHOTOS=<folder>   a data set of your own, with automatic masks (docs/photos.md)'
	@echo 'make new DATASET=mychair PHOTOS=<folder>   begin one with masks and meshes of your own (docs/tutorial.md)'
	@echo 'make validate DATASET=mychair              look at all its files, in a second; then make all DATASET=mychair'
	@echo 'make help-all                              everything else'

help-all:
	@echo 'make all DATASET=eames               run the whole pipeline; DATASET is a name in data/ or a path to a folder'
	@echo 'make <stage> DATASET=…               run one stage and the stages that it needs: $(STAGES)'
	@echo '     SET="solve.cells=800 …"         with other parameters      FORCE=1   run again, even if up to date'
	@echo '     HELD_OUT=0066,0069               photos that this run predicts and does not solve from, or none (docs/evaluate.md)'
	@echo '     STRICT=1                         exit code 3 (2 of make) where the verdict is "do not trust" (docs/verdict.md)'
	@echo '     FACTORLIB_STORE=<folder>         share results with other checkouts (docs/runner.md)'
	@echo 'make render DATASET=… RECIPE=insert   pictures of the result: a name in recipes/, a path to a recipe, or all (docs/recipes.md)'
	@echo 'make plan | why | status DATASET=…   list the steps that would run; every reason; progress and warnings'
	@echo 'make new DATASET=mychair PHOTOS=… MASKS=… MESHES=…   begin a dataset of your own, from folders of files'
	@echo 'make photos DATASET=mychair PHOTOS=… [MESHES=…] [MATTE=<file.onnx>] [WHOLE=1]   the same with automatic masks, cameras and a hull'
	@echo 'make label DATASET=mychair [PORT=…]   draw masks in a browser: boxes, clicks, brush (docs/dataset.md)'
	@echo 'make validate DATASET=…              look at every file of a dataset, without running anything; SHEET=1: a contact sheet'
	@echo 'make params [STAGE=solve]            every parameter: default, range, meaning, as the source states them'
	@echo 'make verify [DATASET=…]              read every stored result and list damaged ones; the next run that needs one makes it again'
	@echo 'make clean [DATASET=…]               remove the results of a dataset, or of all; those of studies: rm -r build/studies'
	@echo 'make test                            lint, layers, types, tests'
	@echo 'make test-long                       the tests that take long, which make test leaves out'
	@echo 'make docs                            docs/ and the library as a site, to build/docs/index.html'
	@echo 'make results [ONLY=operator]          measure what docs/results.md shows, all of it (hours) or one section, and write it there;'
	@echo '                                      ONLY=gallery | notebook: docs/gallery.md, docs/result.ipynb (EXTRAS=notebook)'
	@echo 'make study STUDY=matrix-size         an experiment: table and conclusion, to build/studies/<name>; QUICK=1: one seed, small sets'
	@echo 'make studies                         all experiments (docs/studies.md)'
	@echo 'make data                            make data/ again'
	@echo 'make lock                            requirements.lock from pyproject.toml and what .venv has'
	@echo 'make setup                           only the environment (TORCH_INDEX=<url> for another PyTorch)'
	@echo '     EXTRAS="blender interchange"     and what tests open exported files with: Blender, MaterialX'
	@echo '     EXTRAS=masks                     and the network of automatic masks (docs/photos.md)'
	@echo '     EXTRAS=dask                      and Dask: SET="executor=tcp://…" runs steps on a cluster (docs/distributed.md)'

.DEFAULT:
	@test -e .venv/ready || $(MAKE) setup
	@$(PY) -m factorlib "$$GOAL"

Makefile pipeline.yaml requirements.lock factorlib/setup.py: ;
