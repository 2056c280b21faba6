# `make demo` and `make test` set up their own environment; nothing but python3 and make is needed.
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
# Files that take longest come first, in the order of tests/conftest.py; a worker that is done gets the next one.
# One worker more than there are cores, since tests of networks and of processes mostly wait.
WORKERS ?= $(shell expr $$(getconf _NPROCESSORS_ONLN) + 1)
PYTEST := -m pytest --numprocesses $(WORKERS) --dist loadfile --no-loadscope-reorder
# `make matrix` leaves out what needs reinforcement learning, and compares no recorded answers: they are of one torch.
MATRIX := 3.10 3.12 3.13
MATRIX_TESTS := tests --ignore tests/envs --ignore tests/training --ignore tests/gym --ignore tests/benchmarks \
	--ignore tests/test_answers.py --ignore tests/test_notebooks.py --ignore tests/test_readme.py --ignore tests/docs
EXTRAS := io,bags,odometry,video,view,geo,site,serve,rl,deploy,dev,docs
MJLAB := .venv-mjlab
MUJOCO := .venv-mujoco
ISAACLAB := .venv-isaaclab
NEWTON := .venv-newton
GENESIS := .venv-genesis
PEERS := .venv-peers

.PHONY: help wheel test-wheel demo test test-fast test-library test-mjlab test-mujoco train-mjlab test-isaaclab bench-isaaclab test-newton test-genesis test-ros2 test-ros2-torch bench-ros2 matrix lint types setup bench quality quality-em-cupy quality-levels quality-odometry train-ceilings peers runtime docs clean

help:  ## list the targets
	@grep -E '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed 's/:.*##/\t/' | expand -t 12

# The demo needs the core and the command line only; `setup` adds the rest.
$(BIN)/.demo-ready: pyproject.toml constraints.txt
	@echo "Installing PyTorch and the packages of the command line into $(VENV), nowhere else: 1.3 GB and one to five"
	@echo "minutes with a CPU build of PyTorch; a CUDA build is several times as large."
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --disable-pip-version-check --constraint constraints.txt --editable '.[io]'
	@touch $@

$(BIN)/.ready: $(BIN)/.demo-ready
	@echo "Installing the packages of tests and trainings into $(VENV): another 0.7 GB."
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[$(EXTRAS)]'
	@touch $@

setup: $(BIN)/.ready  ## make the environment .venv

demo: $(BIN)/.demo-ready  ## simulate a walk, map it, write demo.png
	$(BIN)/python -m torchelev demo --out demo.png

# Tests start many processes, which would each compile the Python files again.
unexport PYTHONDONTWRITEBYTECODE
# Workers and the programs that they start share the cores: threads that wait busily would hold them up.
test test-fast test-library test-mjlab test-mujoco test-isaaclab test-newton test-genesis: export OMP_WAIT_POLICY = PASSIVE

test: setup  ## run all tests, on all cores
	$(BIN)/python $(PYTEST)

test-fast: setup  ## run the quick tests, every stage against the reference
	$(BIN)/python $(PYTEST) -m "not slow"

# A wheel with ROS 2 Humble and Jazzy for Python 3.12; of Isaac Sim, which it belongs to, nothing is needed.
ROS2 := .venv-ros2
ROS2_PYTHON ?= $(shell ls -d $${PYENV_ROOT:-$$HOME/.pyenv}/versions/3.12.*/bin/python 2>/dev/null | head -1)
$(ROS2)/.ready: tests/ros2/with_ros/requirements.txt
	$(if $(ROS2_PYTHON),$(ROS2_PYTHON),python3.12) -m venv $(ROS2)
	$(ROS2)/bin/python -m pip install --disable-pip-version-check --quiet --no-deps isaacsim-ros2==6.2.0.0
	$(ROS2)/bin/python -m pip install --disable-pip-version-check --quiet --requirement $<
	@touch $@

$(ROS2)-torch/.ready: tests/ros2/with_ros/requirements.txt tests/ros2/with_ros/requirements-torch.txt
	@echo "Installing ROS 2 and a CUDA build of PyTorch into $(ROS2)-torch, nowhere else: 6 GB."
	$(if $(ROS2_PYTHON),$(ROS2_PYTHON),python3.12) -m venv $(ROS2)-torch
	$(ROS2)-torch/bin/python -m pip install --disable-pip-version-check --quiet --no-deps isaacsim-ros2==6.2.0.0
	$(ROS2)-torch/bin/python -m pip install --disable-pip-version-check --quiet $(patsubst %,--requirement %,$^)
	@touch $@

test-ros2: setup $(ROS2)/.ready  ## test the node in real ROS 2, Humble and Jazzy of a wheel, which needs Python 3.12; eight minutes
	$(BIN)/python -m tests.ros2.with_ros.prepare $(ROS2)/prepared
	$(ROS2)/bin/python tests/ros2/with_ros/run.py $(ROS2)/prepared

test-ros2-torch: setup $(ROS2)-torch/.ready  ## the same with PyTorch's map in place of the C library's; twelve minutes
	$(BIN)/python -m tests.ros2.with_ros.prepare $(ROS2)/prepared
	$(ROS2)-torch/bin/python tests/ros2/with_ros/run.py $(ROS2)/prepared

bench-ros2: setup $(ROS2)/.ready  ## measure the node in ROS 2 Jazzy: latency, CPU and memory, twelve minutes
	$(BIN)/python -m tests.ros2.with_ros.prepare $(ROS2)/prepared
	$(ROS2)/bin/python tests/ros2/with_ros/run.py $(ROS2)/prepared measure benchmarks/results/ros2.json 10

# mjlab pins its own mujoco and rsl-rl-lib.
$(MJLAB)/.ready: pyproject.toml constraints-mjlab.txt
	@echo "Installing mjlab and PyTorch into $(MJLAB), nowhere else: 2.3 GB."
	$(PYTHON) -m venv $(MJLAB)
	$(MJLAB)/bin/python -m pip install --quiet --disable-pip-version-check --constraint constraints-mjlab.txt \
		--editable . mjlab pytest hypothesis
	@touch $@

$(NEWTON)/.ready: pyproject.toml constraints.txt
	@echo "Installing Newton, Warp and PyTorch into $(NEWTON), nowhere else: 1.5 GB."
	$(PYTHON) -m venv $(NEWTON)
	$(NEWTON)/bin/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt \
		--editable . newton==1.8.0 warp-lang==1.19.0 matplotlib pillow pytest hypothesis scipy
	@touch $@

test-newton: $(NEWTON)/.ready  ## run maps in Newton, in the environment .venv-newton; two minutes, of which Warp compiles one
	$(NEWTON)/bin/python -m pytest tests/integrations/test_newton_simulator.py

# Isaac Lab needs Python 3.12 and pins torch, newton, warp and rsl-rl-lib; of Isaac Sim, nothing is needed.
$(ISAACLAB)/.ready: pyproject.toml
	@echo "Installing Isaac Lab 3.0.0 and a CUDA build of PyTorch into $(ISAACLAB), nowhere else: 7.8 GB, five minutes."
	$(if $(ROS2_PYTHON),$(ROS2_PYTHON),python3.12) -m venv $(ISAACLAB)
	$(ISAACLAB)/bin/python -m pip install --quiet --disable-pip-version-check --editable . isaaclab==3.0.0 pytest hypothesis
	@touch $@

test-isaaclab: $(ISAACLAB)/.ready  ## run the observation term in Isaac Lab 3.0.0, in the environment .venv-isaaclab; three minutes
	$(ISAACLAB)/bin/python -m pytest --disable-warnings tests/integrations/isaaclab

bench-isaaclab: setup $(ISAACLAB)/.ready  ## compare the term with Isaac Lab's own height scan, and time both, two minutes
	$(ISAACLAB)/bin/python -W ignore -m benchmarks.quality.isaac_lab
	$(BIN)/python -m docs.readme_tables

$(GENESIS)/.ready: pyproject.toml constraints.txt
	@echo "Installing Genesis and PyTorch into $(GENESIS), nowhere else: 4 GB."
	$(PYTHON) -m venv $(GENESIS)
	$(GENESIS)/bin/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt \
		--editable . genesis-world==1.4.5 pytest hypothesis scipy
	@touch $@

test-genesis: $(GENESIS)/.ready  ## run maps in Genesis, in the environment .venv-genesis; four minutes, of which it compiles three
	$(GENESIS)/bin/python -m pytest tests/integrations/test_genesis_simulator.py

$(MUJOCO)/.ready: pyproject.toml constraints.txt
	@echo "Installing MuJoCo Warp and PyTorch into $(MUJOCO), nowhere else: 1.5 GB."
	$(PYTHON) -m venv $(MUJOCO)
	$(MUJOCO)/bin/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt \
		--editable '.[gym]' mujoco==4.0.0 mujoco-warp==4.0.0 warp-lang==1.19.0 pytest hypothesis scipy
	@touch $@

test-mujoco: $(MUJOCO)/.ready  ## run MuJoCo 4.0 and maps of MuJoCo Warp's worlds, in the environment .venv-mujoco
	$(MUJOCO)/bin/python -m pytest tests/integrations/test_mujoco.py tests/integrations/test_mujoco_warp_simulator.py

train-mjlab: $(MJLAB)/.ready  ## train in mjlab's rough task with the map and the ideal scan, half an hour of two cores
	$(MJLAB)/bin/python -W ignore -m benchmarks.quality.mjlab_training
	$(BIN)/python -m docs.readme_tables

test-mjlab: $(MJLAB)/.ready  ## run the observation term in mjlab, in the environment .venv-mjlab
	$(MJLAB)/bin/python -m pytest tests/integrations/test_mjlab_simulator.py

# Peers are pinned; VDBFusion has wheels for Python 3.6 to 3.10 only, and runs in a second environment where there is one.
PEERS_PYTHON ?= $(shell ls -d $${PYENV_ROOT:-$$HOME/.pyenv}/versions/3.10.*/bin/python 2>/dev/null | head -1)
PEERS_RECORDINGS ?=
PEERS_PROGRAMS ?=
$(PEERS)/.ready: benchmarks/peers/requirements.txt $(BIN)/.demo-ready
	@echo "Installing PyTorch, Open3D and the other peers into $(PEERS) and $(PEERS)-310, nowhere else: 5 GB."
	$(PYTHON) -m venv $(PEERS)
	$(PEERS)/bin/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt \
		--editable '.[io]' scipy --requirement $<
	-$(if $(PEERS_PYTHON),$(PEERS_PYTHON),python3.10) -m venv $(PEERS)-310 && $(PEERS)-310/bin/python -m pip install --quiet \
		--disable-pip-version-check vdbfusion==0.1.6 open3d==0.19.0 'numpy<2'
	@touch $@

peers: $(PEERS)/.ready  ## compare with other maps, in the environment .venv-peers; under thirty minutes
	$(PEERS)/bin/python -W ignore -m benchmarks.peers --python $(PEERS)-310/bin/python \
		$(if $(PEERS_RECORDINGS),--recordings $(PEERS_RECORDINGS)) $(PEERS_PROGRAMS:%=--program %)
	$(BIN)/python -m docs.readme_tables

matrix: $(MATRIX:%=on-%)  ## run the library's quick tests on Python 3.10, 3.12 and 3.13, where they are installed

# The first Python of a version that runs: on the path, or of pyenv.
find_python = $(shell for python in python$(1) $$(ls -d $${PYENV_ROOT:-$$HOME/.pyenv}/versions/$(1).*/bin/python 2>/dev/null); \
	do $$python -c '' 2>/dev/null && echo $$python && break; done)

on-%:
	@python=$(call find_python,$*); [ -n "$$python" ] || { echo "Python $* is not installed here: skipped"; exit 0; }; \
	exec $(MAKE) --no-print-directory VENV=.venv-$* PYTHON=$$python EXTRAS=io,dev test-library

test-library: setup
	@$(BIN)/python -c 'import sys, torch; print("Python", sys.version.split()[0], "torch", torch.__version__)'
	$(BIN)/python $(PYTEST) -m "not slow" $(MATRIX_TESTS)

wheel: setup  ## build a wheel that carries the C++ libraries, for processors of this kind
	$(BIN)/python -m torchelev.app.build_ahead
	$(BIN)/python -m hatchling build -t wheel

test-wheel: $(addprefix wheel-on-,3.10 3.11 3.12 3.13)  ## install the wheel on each Python, and run the demo; 5 GB for each

# As a user installs it: no checkout in the way, and the packages that pip chooses.
wheel-on-%: wheel
	@python=$(call find_python,$*); [ -n "$$python" ] || { echo "Python $* is not installed here: skipped"; exit 0; }; \
	place=$$(mktemp -d) && $$python -m venv $$place/venv && \
	$$place/venv/bin/python -m pip install --quiet --disable-pip-version-check "$$(ls $(CURDIR)/dist/*.whl)[io]" && \
	cd $$place && venv/bin/torchelev demo --out demo.png && ls -l demo.png && venv/bin/python -c \
		"import torch, torchelev; print('Python $*, torch', torch.__version__, torchelev.ElevationMap().backend)" && \
	rm -rf $$place

lint: setup  ## check style, and that imports go downwards
	$(BIN)/ruff check --no-cache .
	$(BIN)/ruff format --check --quiet .
	$(BIN)/lint-imports
	@! git grep -nE '^(<{7}|>{7})( |$$)' || { echo 'a merge has left its markers there'; exit 1; }

types: setup  ## check types
	$(BIN)/mypy

bench: setup  ## measure speed and scale, under ten minutes
	$(BIN)/python -m benchmarks.speed.run
	$(BIN)/python -m docs.readme_tables

quality: setup  ## measure accuracy and features, five minutes
	$(BIN)/python -m benchmarks.quality.accuracy
	$(BIN)/python -m benchmarks.quality.features
	$(BIN)/python -m benchmarks.quality.silence
	$(BIN)/python -m docs.readme_tables

# GOLDENS: folder of what elevation_mapping_cupy's kernels computed, and beside it the weights of its filter
quality-em-cupy: setup  ## compare maps with those of elevation_mapping_cupy: GOLDENS=<folder>
	$(BIN)/python -m benchmarks.quality.em_cupy $(GOLDENS)/em_cupy/open --weights $(GOLDENS)/traversability_filter_weights.npz
	$(BIN)/python -m docs.readme_tables

quality-levels: setup  ## measure maps with levels in exact scenes, and their cost, ten minutes
	$(BIN)/python -m benchmarks.quality.levels
	$(BIN)/python -m benchmarks.quality.levels.one_height
	$(BIN)/python -m benchmarks.speed.levels
	$(BIN)/python -m docs.readme_tables

quality-odometry: setup  ## measure maps whose poses come from the clouds, five minutes
	$(BIN)/python -m benchmarks.quality.odometry
	$(BIN)/python -m docs.readme_tables

train-ceilings: setup  ## train policies with and without sight of ceilings, an hour of two cores
	$(BIN)/python -m training.nav.ceiling_experiment
	$(BIN)/python -m docs.readme_tables

runtime: setup  ## measure the C library, and prove its answers on other processors and under sanitizers, half an hour
	$(BIN)/python -m benchmarks.runtime speed
	$(BIN)/python -m benchmarks.runtime replay
	$(BIN)/python -m benchmarks.runtime spacing
	$(BIN)/python -m benchmarks.runtime processors
	$(BIN)/python -m benchmarks.runtime sanitize

docs: setup  ## build the documentation in docs/_build/html, warnings as errors; needs no network once it is set up
	$(BIN)/python -m sphinx -b html -W --keep-going --quiet -d docs/_build/trees docs docs/_build/html
	@echo "Open docs/_build/html/index.html"

clean:  ## remove what the targets made
	rm -rf $(VENV) $(MJLAB) $(ISAACLAB) $(NEWTON) $(GENESIS) $(PEERS) $(PEERS)-310 $(ROS2) $(ROS2)-torch $(MATRIX:%=.venv-%) demo.png docs/_build docs/notebooks
