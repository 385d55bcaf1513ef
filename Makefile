# `make train` and `make test` are all a new clone needs: the first call makes .venv and installs,
# later calls install nothing until pyproject.toml or constraints.txt change.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready
# Only what is used is compiled, when it is first used, and kept: compiling takes longer than importing.
PIP_INSTALL := pip install --quiet --no-compile
export PYTHONDONTWRITEBYTECODE :=
# Safety-Gymnasium pins an older Gymnasium and MuJoCo than ours.
SAFETY := .venv-safety-gymnasium
SAFETY_FILES := $(addprefix tests/with_safety_gymnasium/,requirements.txt make_importable.py)
OMNISAFE_FILE := tests/with_safety_gymnasium/omnisafe.txt

# What rounds differently from one processor to the next: losses, trust region, multipliers, metrics.
NUMERICAL := $(addprefix tests/test_,$(addsuffix .py,constrained_losses constrained_optimum cost_gae \
	cost_td0 default_rule family first_order first_order_interface focops_and_cup functional heads lagrangian \
	learners masks metrics p3o_ipo_crpo \
	multi_agent multipliers multipliers_interface off_policy off_policy_interface offpolicy_optimum \
	pid_control ppo_cases ppo_lagrangian ppo_lagrangian_interface sac_lagrangian scaling trust_region \
	trust_region_actors trust_region_loss trust_region_optimum trust_region_refusals trust_region_step violation))

.PHONY: train test test-integration test-kernels test-slow test-wheel test-safety-gymnasium safe-gym safe-gym-grid \
	bench-omnisafe compare suite paper sweep profile gallery bench draws attack ray docs lint format type clean

train: $(READY)  ## the main job; options go in ARGS="--seed 1 --action joint"
	$(BIN)/python -m experiments.train $(ARGS)

# One thread each: the processes have the cores to themselves. Tests of one file share its long runs.
# Files keep their order: xdist would begin those with few tests last, some of which are long.
PARALLEL := -n 2 --dist loadfile --no-loadscope-reorder

test: $(VENV)/.bullet-safety-gym  ## the parts, on two cores; CI also runs test-integration
	OMP_NUM_THREADS=1 $(BIN)/pytest $(PARALLEL) -m "not integration and not slow" $(ARGS)

test-integration: $(VENV)/.bullet-safety-gym  ## programs, pages and trainings from beginning to end
	OMP_NUM_THREADS=1 $(BIN)/pytest $(PARALLEL) -m "integration and not slow" $(ARGS)

# The kernels that every processor has, in place of those that it is best at.
test-kernels: $(READY)  ## the numerical tests once more, as another processor rounds
	MKL_CBWR=COMPATIBLE ATEN_CPU_CAPABILITY=default OMP_NUM_THREADS=1 $(BIN)/pytest $(PARALLEL) \
		-m "not slow" $(NUMERICAL) $(ARGS)

test-slow: $(READY)  ## every combination, and the tests that train for minutes
	OMP_NUM_THREADS=1 $(BIN)/pytest $(PARALLEL) -m slow $(ARGS)

test-safety-gymnasium: $(SAFETY)/.ready  ## with Safety-Gymnasium itself, in an environment of its own
	OMP_NUM_THREADS=1 $(SAFETY)/bin/pytest tests/with_safety_gymnasium $(ARGS)

safe-gym: $(SAFETY)/.ready  ## train in Safety-Gymnasium: ARGS="--env SafetySwimmerVelocity-v1"
	$(SAFETY)/bin/python -m experiments.safe_gym $(ARGS)

safe-gym-grid: $(SAFETY)/.omnisafe  ## against OmniSafe; goes on where it was stopped
	$(SAFETY)/bin/python -m experiments.safe_gym_grid $(ARGS)

bench-omnisafe: $(SAFETY)/.omnisafe  ## speed against OmniSafe; wants a quiet machine
	OMP_NUM_THREADS=1 $(SAFETY)/bin/python -m benchmarks.omnisafe $(ARGS)

test-wheel:  ## the package as people get it: an empty environment, with and without the arms
	PYTHON=$(PYTHON) .ci/test-wheel

compare: $(READY)  ## every algorithm on the same task; goes on where it was stopped
	$(BIN)/python -m experiments.compare $(ARGS)

suite: $(READY)  ## ten tasks with their limits, five seeds; goes on where it was stopped
	$(BIN)/python -m experiments.suite $(ARGS)

paper: $(READY)  ## Table 1 and Figure 2 of the paper, run again; goes on where it was stopped
	$(BIN)/python -m experiments.paper $(ARGS)

sweep: $(READY)  ## is the limit kept, whatever it is? goes on where it was stopped
	$(BIN)/python -m experiments.sweep $(ARGS)

profile: $(READY)  ## return and cost for fixed multipliers; goes on where it was stopped
	$(BIN)/python -m experiments.multiplier_profile $(ARGS)

bench: $(READY)  ## ratios against the physics floor and other libraries; wants a quiet machine
	OMP_NUM_THREADS=1 $(BIN)/python -m benchmarks $(ARGS)

draws: $(READY)  ## starts of every registered combination, without physics: how many find no room
	$(BIN)/python tests/draws.py $(ARGS)

attack: $(READY)  ## tries to make a shielded arm touch something: ARGS="--steps 1000000"
	$(BIN)/python tests/attack.py $(ARGS)

ray: $(READY)  ## two costs on a Ray cluster; on this machine, or on yours with ARGS="--address auto"
	$(BIN)/python -m experiments.ray_training $(ARGS)

gallery: $(READY)  ## the pictures of docs/environments.md
	$(BIN)/python -m experiments.gallery --out docs/figures/gallery.png $(ARGS)

docs: $(READY)  ## these pages, the tutorials (run where new) and the API reference, in docs/_build
	OMP_NUM_THREADS=1 $(BIN)/sphinx-build -qW docs docs/_build $(ARGS)

lint: $(READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/codespell torchrl_safe experiments benchmarks tests tutorials docs *.md

format: $(READY)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

type: $(READY)
	$(BIN)/mypy

clean:
	rm -rf $(VENV) $(SAFETY) docs/_build docs/tutorials

$(READY): pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/$(PIP_INSTALL) --constraint constraints.txt --editable ".[dev]"
	touch $@

# It pins an old Gymnasium, and runs with ours.
$(VENV)/.bullet-safety-gym: $(READY)
	$(BIN)/$(PIP_INSTALL) --constraint constraints.txt --no-deps bullet-safety-gym
	touch $@

$(SAFETY)/.ready: pyproject.toml constraints.txt $(SAFETY_FILES)
	$(PYTHON) -m venv $(SAFETY)
	$(SAFETY)/bin/$(PIP_INSTALL) --constraint constraints.txt --editable . pytest tqdm tyro
	$(SAFETY)/bin/$(PIP_INSTALL) --no-deps --requirement tests/with_safety_gymnasium/requirements.txt
	$(SAFETY)/bin/python tests/with_safety_gymnasium/make_importable.py
	touch $@

$(SAFETY)/.omnisafe: $(SAFETY)/.ready $(OMNISAFE_FILE)
	$(SAFETY)/bin/$(PIP_INSTALL) --no-deps --requirement $(OMNISAFE_FILE)
	touch $@
