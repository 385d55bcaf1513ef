"""Pilots do every task, past obstacles without a touch, from whatever state they find."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from worlds import ARMS

from experiments.pilots import CAREFUL, HURRIED, act, make_pilot
from torchrl_safe.envs import (
    SUITE,
    UR5,
    UR10,
    ArmEnv,
    CartesianDelta,
    Cylinder,
    InFront,
    JointDelta,
    MuJoCo,
    NoObstacles,
    PickAndPlace,
    Push,
    Reach,
    Region,
    Scattered,
)

pytestmark = pytest.mark.integration

TASKS = {"reach": (Reach(), 60), "push": (Push(), 200), "pick": (PickAndPlace(), 100)}


def settings(arm, task):
    """Of an environment, with time enough."""
    goal, steps = TASKS[task]
    fingers = 0.04 if task == "pick" else None
    held = None if task == "reach" else arm.handling_orientation
    action = CartesianDelta(step=0.03, orientation=held, finger_step=fingers)
    return {"task": goal, "action": action, "max_episode_steps": steps}


def fly(env, noise=0.0, care=CAREFUL, pilot=None):
    """Plays one episode in each world; returns success and cost of each."""
    env.reset()
    pilot, generator = pilot or make_pilot(env, care), np.random.default_rng(0)
    alive, success = np.ones(env.num_envs, bool), np.zeros(env.num_envs, bool)
    cost = np.zeros((env.num_envs, len(env.cost_names)))
    while alive.any():
        action = act(env, pilot)
        assert np.abs(action).max() <= 0.9 + 1e-6
        action = action + noise * generator.normal(size=action.shape)
        action = torch.as_tensor(action, dtype=torch.float32)
        result = env.step(TensorDict({"action": action}, batch_size=[env.num_envs]))["next"]
        cost += np.where(alive[:, None], result["cost"], 0)
        success |= alive & result["success"][:, 0].numpy()
        alive &= ~result["done"][:, 0].numpy()
    return success, cost


@pytest.mark.parametrize("task", TASKS)
@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=() if name == "panda" else pytest.mark.slow) for name in ARMS],
)
def test_success_costs_next_to_nothing(make_env, name, task):
    arm = ARMS[name]
    env = make_env(
        ArmEnv, arm, num_envs=16, seed=0, physics=MuJoCo(threads=1), **settings(arm, task)
    )
    success, cost = fly(env)
    assert success.all()
    assert cost.mean() <= 0.5


def scattered(arm, task):
    """One or two obstacles where the straight way often leads.

    The hand passes over those beside which an object is pushed. Over those beside which one is
    picked up it is carried; the forearm of a UR is too low for more than 8 cm.
    """
    height = 0.06 if task == "push" else 0.08 if arm in (UR5, UR10) else 0.12
    (near, *_), (far, *_) = arm.goals.low, arm.goals.high
    region = Region((near, -0.1, 0), (far, 0.1, 0))
    shape = Cylinder(0.03, height)
    return Scattered(2, fewest=1, region=region, shape=shape, clearance=0.1, spacing=0.05)


@pytest.mark.parametrize(
    ("name", "task"),
    [
        pytest.param(
            name, task, marks=() if (name, task) == ("panda", "push") else pytest.mark.slow
        )
        for name in ARMS
        for task in ("push", "pick")
    ],
)
def test_success_costs_nothing_among_scattered_obstacles(make_env, engine, name, task):
    """For a pilot that looks where they are. One that does not, fails or touches them."""
    arm = ARMS[name]
    chosen = {"obstacles": scattered(arm, task), "seed": 0, **settings(arm, task)}
    env = make_env(ArmEnv, arm, num_envs=8, **chosen)
    success, cost = fly(env)
    assert success.all()
    assert not cost.any()
    careful = make_pilot(env)

    def careless(state):
        nothing = np.zeros_like(state.obstacle_present)
        return careful(replace(state, obstacle_present=nothing))

    env.set_seed(0)
    success, cost = fly(env, pilot=careless)
    assert (success & ~cost.any(1)).sum() < 8


@pytest.mark.parametrize(
    ("task", "obstacles"),
    [("push", NoObstacles()), ("pick", NoObstacles()), ("pick", Scattered())],
    ids=["push", "pick", "pick-scattered"],
)
def test_success_without_an_obstacle_in_the_way(make_env, task, obstacles):
    arm = ARMS["panda"]
    chosen = {"obstacles": obstacles, "physics": MuJoCo(threads=1), **settings(arm, task)}
    success, _ = fly(make_env(ArmEnv, arm, num_envs=8, seed=0, **chosen))
    assert success.all()


@pytest.mark.parametrize(
    "name", [name for name, task in SUITE.items() if not isinstance(task.task, Reach)]
)
def test_the_limits_of_the_suite_can_be_kept(make_env, name):
    task = SUITE[name]
    env = make_env(task.make_env, num_envs=24, physics=MuJoCo(threads=1), seed=10)
    success, cost = fly(env)
    assert success.mean() >= 0.95
    assert (cost.mean(0) <= [*task.cost_limits.values()]).all(), cost.mean(0)


@pytest.mark.parametrize(
    ("name", "violated"),
    [
        ("panda-push-human", "separation"),
        ("panda-pick-in-front", "clearance"),
        ("ur10-pick-workspace", "clearance"),
    ],
)
def test_who_is_in_a_hurry_does_the_task_and_violates_a_limit(make_env, name, violated):
    task = SUITE[name]
    env = make_env(task.make_env, num_envs=24, physics=MuJoCo(threads=1), seed=10)
    success, cost = fly(env, care=HURRIED)
    assert success.mean() >= 0.95
    costs = dict(zip(env.cost_names, cost.mean(0), strict=True))
    assert costs[violated] >= 2 * task.cost_limits[violated]


@pytest.mark.parametrize("task", ["push", "pick"])
def test_mistakes_are_mended(make_env, task):
    """Which is what there is to be learnt from a pilot."""
    arm = ARMS["panda"]
    chosen = {"obstacles": NoObstacles(), "physics": MuJoCo(threads=1), **settings(arm, task)}
    success, _ = fly(make_env(ArmEnv, arm, num_envs=8, seed=0, **chosen), noise=0.2)
    assert success.mean() >= 0.75


def test_a_pilot_is_a_function_of_the_state(make_env):
    """It gives each world the same advice, whatever the others do, and at any time."""
    arm = ARMS["panda"]
    chosen = {"num_envs": 4, "seed": 0, "physics": MuJoCo(threads=1), **settings(arm, "push")}
    env = make_env(ArmEnv, arm, obstacles=InFront(), **chosen)
    env.reset()
    pilot = make_pilot(env)
    first = act(env, pilot)
    env.rollout(3, auto_reset=True)
    env.set_seed(0)
    env.reset()
    np.testing.assert_array_equal(act(env, pilot), first)
    alone = make_env(ArmEnv, arm, obstacles=InFront(), **{**chosen, "num_envs": 1})
    alone.reset()
    np.testing.assert_allclose(act(alone, make_pilot(alone))[0], first[0], atol=1e-12)


def test_who_has_no_pilot(make_env):
    env = make_env(ArmEnv, action=JointDelta(), physics=MuJoCo(threads=1))
    with pytest.raises(ValueError, match="demonstrations need Cartesian actions, got JointDelta"):
        make_pilot(env)
