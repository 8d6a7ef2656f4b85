# Every target sets up what it needs first; no environment has to be active.
#   make lens-opt ARGS="--quick --out runs/mine"      PYTHON=/path/to/python3.12 chooses the interpreter
SHELL := bash
.DEFAULT_GOAL := help
PYTHON ?=
ARGS ?=
STUDY :=
RUN := .venv/bin/python
INSTALL := $(RUN) -m pip install --disable-pip-version-check --quiet --constraint constraints.txt --editable
STUDIES := lens-opt lens-report lens-tolerance lens-bench dataset video-to-events \
	srm-bench sensor-fit train-flow flow-quality flow-recording \
	placement codesign speed-error stability gradcheck

.PHONY: help setup docs evidence test bench-check cuda-check fuzz kill-test test-bits lint core-check try-all doctor clean $(STUDIES)

help: ## this list
	@sed -n 's/^\([a-z-]*\):.*## /  make \1|/p' Makefile | awk -F'|' '{printf "%-24s %s\n", $$1, $$2}'

setup: .venv/with-dev.stamp .venv/llvm.stamp ## environment, every package and LLVM (only what has changed)

# the core, and each extra of pyproject.toml when a target wants it
.venv/core.stamp: pyproject.toml constraints.txt setup/make_venv.sh
	@setup/make_venv.sh .venv "$(PYTHON)"
	@echo "installing the packages of pyproject.toml into .venv (some minutes the first time)"
	@$(INSTALL) .
	@touch $@

.venv/with-%.stamp: .venv/core.stamp
	@$(INSTALL) ".[$*]"
	@touch $@

.venv/llvm.stamp: .venv/core.stamp setup/install_llvm.sh
	@if setup/install_llvm.sh $(RUN); then touch $@; fi

# a study: the target's name with _ for -, or what STUDY says; more prerequisites stand with the target below
$(STUDIES): .venv/core.stamp .venv/llvm.stamp
	@$(RUN) -m studies.$(or $(STUDY),$(subst -,_,$@)) $(ARGS)

lens-opt: .venv/with-video.stamp ## optimise a lens for event flow, the main job
lens-report: ## everything about one lens: make lens-report ARGS="--lens double-gauss"
lens-tolerance: ## what errors of making and mounting do to a lens
lens-bench: .venv/with-bench.stamp ## speed and error against another ray tracer (installs it)
lens-bench: STUDY := speed_error --stages lens
dataset: .venv/with-event-files.stamp ## render trajectories with events and ground truth
dataset: STUDY := make_dataset
video-to-events: .venv/with-event-files.stamp .venv/with-video.stamp ## events out of a video: make video-to-events ARGS="--input clip.mp4"
srm-bench: .venv/with-bench.stamp ## the spiking layer against a convolution and two spiking libraries (installs them)
srm-bench: STUDY := speed_error --stages spiking
sensor-fit: .venv/with-event-files.stamp ## fit a sensor to a recording of yours: make sensor-fit ARGS="--recording FILE.aedat4"
train-flow: .venv/with-event-files.stamp .venv/with-training-logs.stamp ## train a flow network: make train-flow ARGS="--network refiner --cpu-minutes 20"
flow-quality: ## error of the delivered refiner and of the closed form on unseen textures and worlds
flow-recording: .venv/with-event-files.stamp ## flow of a recording: make flow-recording ARGS="--recording FOLDER"
placement: .venv/with-search.stamp ## where to mount the camera on a robot
codesign: .venv/with-search.stamp ## lens, mount, sensor and estimator designed together, raced against every other order
speed-error: ## time, memory and error of every stage: make speed-error ARGS="--stages lens events flow"
stability: ## hard cases: outcome expected and seen
gradcheck: ## every gradient against differences, right, wrong or not judgeable: make gradcheck ARGS=--quick
gradcheck: STUDY := gradient_flow

docs: .venv/with-docs.stamp ## the docs as a site with search and API: open site/index.html
	@NO_MKDOCS_2_WARNING=1 $(RUN) -m mkdocs build --strict

evidence: setup ## the figures of README and docs whose code has changed, measured again: make evidence ARGS="lens-motion"
	@$(RUN) setup/evidence.py $(ARGS)

test: setup ## all tests, on all cores
	@$(RUN) -m pytest -n auto --maxprocesses 8 --dist worksteal $(ARGS)

bench-check: setup ## speed beside plain torch work, against the committed ratios (fails when 20 % worse)
	@$(RUN) setup/bench.py check $(ARGS)

cuda-check: setup ## on a GPU: its tests, speed, training in bfloat16; writes docs/speed_cuda.md
	@$(RUN) setup/bench.py cuda $(ARGS)

fuzz: setup ## mutants of every file format for hours: make fuzz ARGS="--minutes 120 --format .npz"
	@$(RUN) -m tests.hostile fuzz $(ARGS)

kill-test: setup ## long studies killed at random moments, resumed and compared: make kill-test ARGS="--count 50"
	@$(RUN) -m tests.hostile kills $(ARGS)

test-bits: setup ## tests that promise equal bits, as other processors and numbers of threads round
	@failed=0; for how in \
	    "CODESIGN_TEST_ROUNDING=place MKL_CBWR=COMPATIBLE ATEN_CPU_CAPABILITY=default CODESIGN_TEST_THREADS=2" \
	    "MKL_CBWR=AVX2 ATEN_CPU_CAPABILITY=avx2" \
	    "MKL_CBWR=AVX512 CODESIGN_TEST_THREADS=2"; do \
	  echo "== $$how"; \
	  env $$how $(RUN) -m pytest -q -n auto --maxprocesses 8 --dist worksteal -m bits $(ARGS) \
	    $$(grep -rl --include='test_*.py' 'mark\.bits' tests) || failed=1; \
	done; exit $$failed

lint: setup ## format, ruff and pyright
	@$(RUN) -m ruff format --check .
	@$(RUN) -m ruff check .
	@$(RUN) -m pyright $(ARGS)

core-check: ## an environment of its own with the core alone: everything is imported, lens_opt runs
	@setup/core_check.sh "$(PYTHON)"

try-all: setup ## every command of README, docs and Makefile in its quick form, one table (an hour or two)
	@$(RUN) setup/try_all.py $(ARGS)

doctor: setup ## what is installed, what is missing, what to do
	@$(RUN) -m codesign doctor

clean: ## remove the environment and caches; results in runs/ stay
	rm -rf .venv build *.egg-info .pytest_cache .pytest_log .pytest_core .ruff_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
