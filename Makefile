# Every target sets up what it needs first; no environment has to be active.
#   make lens-opt ARGS="--quick --out runs/mine"      PYTHON=/path/to/python3.12 chooses the interpreter
SHELL := bash
.DEFAULT_GOAL := help
PYTHON ?=
ARGS ?=
RUN := .venv/bin/python

.PHONY: help setup lens-opt lens-report lens-scratch lens-tolerance lens-bench silhouettes dataset video-to-events event-gradient event-bench srm-bench davis train-flow flow-quality flow-compare flow-cost flow-recording placement speed-error stability gradcheck test lint doctor clean

help: ## this list
	@sed -n 's/^\([a-z-]*\):.*## /  make \1|/p' Makefile | awk -F'|' '{printf "%-20s %s\n", $$1, $$2}'

setup: .venv/installed.stamp .venv/llvm.stamp ## environment, packages and LLVM (only what has changed)

.venv/installed.stamp: pyproject.toml constraints.txt setup/make_venv.sh
	@setup/make_venv.sh .venv "$(PYTHON)"
	@echo "installing the packages of pyproject.toml into .venv (some minutes the first time)"
	@$(RUN) -m pip install --disable-pip-version-check --quiet --editable ".[dev]" --constraint constraints.txt
	@touch $@

.venv/llvm.stamp: .venv/installed.stamp setup/install_llvm.sh
	@if setup/install_llvm.sh $(RUN); then touch $@; fi

lens-opt: setup ## optimise a lens for event flow, the main job
	@$(RUN) -m studies.lens_opt $(ARGS)

lens-report: setup ## everything about one lens: make lens-report ARGS="--lens double-gauss"
	@$(RUN) -m studies.lens_report $(ARGS)

lens-scratch: setup ## triplets designed from flat plates
	@$(RUN) -m studies.lens_scratch $(ARGS)

lens-tolerance: setup ## what errors of making and mounting do to a lens
	@$(RUN) -m studies.lens_tolerance $(ARGS)

lens-bench: setup ## speed and error against other ray tracers (installs them)
	@$(RUN) -m pip install --disable-pip-version-check --quiet --editable ".[bench]" --constraint constraints.txt
	@$(RUN) -m studies.lens_bench $(ARGS)

silhouettes: setup ## gradients where objects hide one another
	@$(RUN) -m studies.silhouettes $(ARGS)

dataset: setup ## render trajectories with events and ground truth
	@$(RUN) -m studies.make_dataset $(ARGS)

video-to-events: setup ## events out of a video: make video-to-events ARGS="--input clip.mp4"
	@$(RUN) -m studies.video_to_events $(ARGS)

event-gradient: setup ## gradients of the event layers against differences of hard counts
	@$(RUN) -m studies.event_gradient $(ARGS)

event-bench: setup ## speed and memory of the event stage
	@$(RUN) -m studies.event_bench $(ARGS)

srm-bench: setup ## the spiking layer against a convolution and two spiking libraries (installs them)
	@$(RUN) -m pip install --disable-pip-version-check --quiet --editable ".[bench]" --constraint constraints.txt
	@$(RUN) -m studies.srm_bench $(ARGS)

davis: setup ## a sensor fitted to a real recording, judged on its other half
	@$(RUN) -m studies.davis_fit $(ARGS)

train-flow: setup ## train a flow network: make train-flow ARGS="--network refiner --cpu-minutes 20"
	@$(RUN) -m studies.train_flow $(ARGS)

flow-quality: setup ## error of the delivered refiner and of the closed form on unseen textures and worlds
	@$(RUN) -m studies.flow_quality $(ARGS)

flow-compare: setup ## the refiner against networks of its size, same windows and budget
	@$(RUN) -m studies.flow_compare $(ARGS)

flow-cost: setup ## time and memory of flow estimators
	@$(RUN) -m studies.flow_cost $(ARGS)

flow-recording: setup ## flow of a recording: make flow-recording ARGS="--recording FOLDER"
	@$(RUN) -m studies.flow_recording $(ARGS)

placement: setup ## where to mount the camera on a robot
	@$(RUN) -m studies.placement $(ARGS)

speed-error: setup ## time and error of every fidelity level
	@$(RUN) -m studies.speed_error $(ARGS)

stability: setup ## hard cases: outcome expected and seen
	@$(RUN) -m studies.stability $(ARGS)

gradcheck: setup ## autograd against differences, junction by junction
	@$(RUN) -m studies.gradient_flow $(ARGS)

test: setup ## all tests
	@$(RUN) -m pytest $(ARGS)

lint: setup ## ruff and pyright
	@$(RUN) -m ruff check .
	@$(RUN) -m pyright $(ARGS)

doctor: setup ## what is installed, what is missing, what to do
	@$(RUN) -m codesign doctor

clean: ## remove the environment and caches; results in runs/ stay
	rm -rf .venv build *.egg-info .pytest_cache .ruff_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
