"""The suite: its rows and doors. Each limit can be kept, and who ignores it exceeds it."""

import dataclasses
from typing import get_args

import gymnasium
import numpy as np
import pytest
import torch
from scripted import fly, over, straight, wary
from tensordict import TensorDict
from worlds import ARMS, placements

from experiments.config import CostName, SuiteTaskName
from experiments.environment import COSTS
from torchrl_safe.envs import (
    PANDA,
    SUITE,
    ArmEnv,
    CartesianDelta,
    Collision,
    Human,
    InFront,
    JointDelta,
    Moving,
    MuJoCo,
    PickAndPlace,
    Push,
    Reach,
    Scattered,
    SuiteTask,
    gym,
)

FAST = MuJoCo(threads=1)
each_task = pytest.mark.parametrize("task", SUITE.values(), ids=SUITE.keys())


def row(**changes):
    settings = {
        "name": "mine",
        "arm": PANDA,
        "task": Reach(),
        "obstacles": InFront(),
        "costs": {"collision": Collision()},
        "cost_limits": {"collision": 1.0},
    }
    return SuiteTask(**{**settings, **changes})


def test_what_is_in_it():
    rows = SUITE.values()
    assert len(rows) == 10
    assert {id(task.arm) for task in rows} == {id(arm) for arm in ARMS.values()}
    assert {type(task.task) for task in rows} == {Reach, Push, PickAndPlace}
    assert {type(task.obstacles) for task in rows} == {InFront, Scattered, Moving, Human}
    assert {type(task.action) for task in rows} == {CartesianDelta, JointDelta}
    assert sum(len(task.costs) > 1 for task in rows) >= 3
    # A kind of task has one number of frames and one length of an episode.
    for kind in (Reach, Push, PickAndPlace):
        of_kind = [task for task in rows if isinstance(task.task, kind)]
        assert len({(task.frames, task.max_episode_steps) for task in of_kind}) == 1


def test_names_are_those_of_the_scripts():
    assert get_args(SuiteTaskName) == tuple(SUITE)
    assert get_args(CostName) == tuple(COSTS)


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({"name": "My task"}, ValueError, "name must be lower-case words joined by hyphens"),
        ({"name": ""}, ValueError, "name must be lower-case words joined by hyphens, got ''"),
        ({"arm": "panda"}, TypeError, "arm must be an instance of ArmModel"),
        ({"task": Reach}, TypeError, r"task must be an instance of Task, got .*Reach'>, a class"),
        ({"obstacles": None}, TypeError, "obstacles must be an instance of Obstacles"),
        ({"action": 3}, TypeError, "action must be an instance of ActionMode"),
        ({"costs": {}}, ValueError, "cost_limits must have a limit for each of costs"),
        ({"cost_limits": {"speed": 1.0}}, ValueError, r"costs \['collision'\], .* \['speed'\]"),
        ({"cost_limits": {"collision": 0.0}}, ValueError, "limit of collision must be positive"),
        ({"frames": 0}, ValueError, "frames must be a whole number of at least 1, got 0"),
        ({"max_episode_steps": 1.5}, ValueError, "max_episode_steps must be a whole number"),
    ],
)
def test_bad_rows(changes, error, message):
    with pytest.raises(error, match=message):
        row(**changes)


@each_task
def test_each_makes_an_environment(make_env, task):
    env = make_env(task.make_env, num_envs=2, physics=FAST, seed=0)
    assert env.cost_names == tuple(task.cost_limits)
    assert env.max_episode_steps == task.max_episode_steps
    rollout = env.rollout(3)
    assert rollout["next", "cost"].shape == (2, 3, len(task.costs))
    assert env.arm is task.arm
    assert env.action_mode.moves_fingers == isinstance(task.task, PickAndPlace)


def test_what_the_task_decides_on_is_refused():
    with pytest.raises(TypeError, match="obstacles must not be given: mine decides on it"):
        row().make_env(obstacles=Human())


@pytest.mark.parametrize("name", ["panda-reach-human", "iiwa-reach-joints"])
def test_each_has_a_name_in_gymnasium(name):
    assert gym.ArmGymEnv
    env = gymnasium.make(f"torchrl_safe/{name}-v0", physics=FAST)
    env.reset(seed=0)
    *_, info = env.step(env.action_space.sample())
    assert list(info["costs"]) == [*SUITE[name].cost_limits]
    env.close()
    assert {f"torchrl_safe/{each}-v0" for each in SUITE} <= set(gymnasium.registry)


# ---------------------------------------------------------------- pilots


class ThroughJoints:
    """An environment with joint actions, as one with Cartesian actions to pilots."""

    def __init__(self, env):
        self.env, self.action_mode = env, CartesianDelta()
        self.action_spec = torch.zeros(env.num_envs, 3)

    def __getattr__(self, name):
        return getattr(self.env, name)

    def step(self, tensordict):
        state, step = self.env.arm_state, self.env.action_mode.step
        ways = tensordict["action"].double().numpy()
        joints, _ = self.action_mode.targets(ways, state, self.env._simulator)
        turns = (joints - state.joint_position) / step
        turns /= np.maximum(1, np.abs(turns).max(1, keepdims=True))
        action = torch.as_tensor(turns, dtype=torch.float32)
        return self.env.step(TensorDict({"action": action}, batch_size=[len(action)]))


def make_world(make_env, name):
    env = make_env(SUITE[name].make_env, num_envs=8, physics=FAST, seed=10)
    return ThroughJoints(env) if isinstance(env.action_mode, JointDelta) else env


def mean_costs(env, cost):
    return dict(zip(env.cost_names, np.reshape(cost, (env.num_envs, -1)).mean(0), strict=True))


@pytest.mark.parametrize(
    ("name", "careful", "share"),
    [
        ("panda-reach-in-front", over, 0.65),
        ("panda-reach-scattered", over, 0.65),
        ("ur5-reach-moving", over, 0.65),
        # Below 1 m/s.
        ("iiwa-reach-joints", over, 0.4),
    ],
)
def test_success_costs_nothing(make_env, name, careful, share):
    env = make_world(make_env, name)
    if isinstance(SUITE[name].obstacles, Moving):
        careful = wary(careful, placements(env))
    success, _, cost = fly(env, careful, share=share)
    assert success.all()
    assert not cost.any()


def gentle(steps):
    """Back and up from home for some steps, then to the goal, the last 0.2 m more slowly."""

    def pilot(env, row):
        away = env.arm_state.ee_position[row] + [-0.1, 0, 0.25]
        for _ in range(steps):
            yield away, 0.0
        while True:
            tool = env.arm_state.ee_position[row]
            way = env.arm_state.goal[row] - tool
            near = np.linalg.norm(way) < 0.2
            yield tool + way * min(1, 0.015 / np.abs(way).max() if near else 1), 0.0

    return pilot


@pytest.mark.integration
def test_success_costs_nothing_beside_the_person(make_env):
    """To who knows when the person will be gone: in each episode one of some times is right."""
    env = make_world(make_env, "panda-reach-human")
    free = np.zeros(env.num_envs, bool)
    for steps in range(0, 46, 3):
        env.set_seed(10)
        success, _, cost = fly(env, gentle(steps), share=1.0)
        free |= success & ~cost.any(1)
    assert free.all()


# What the limits are there for, and how often they are exceeded by who goes straight at the goal.
BINDING = {
    "panda-reach-in-front": {"collision": 3},
    "panda-reach-scattered": {"collision": 3},
    "ur5-reach-moving": {"collision": 3},
    "panda-reach-human": {"separation": 1.5},
    "iiwa-reach-joints": {"collision": 3},
}


@pytest.mark.parametrize("name", BINDING)
def test_who_ignores_the_limits_exceeds_them(make_env, name):
    env = make_world(make_env, name)
    costs = mean_costs(env, fly(env, straight, share=1.0)[2])
    for cost, times in BINDING[name].items():
        assert costs[cost] > times * SUITE[name].cost_limits[cost], costs


def test_the_defaults_are_todays_task(make_env):
    """The first row is what `make train` trains."""
    task = SUITE["panda-reach-in-front"]
    own = make_env(task.make_env, num_envs=2, physics=FAST, seed=0)
    env = make_env(ArmEnv, num_envs=2, physics=FAST, seed=0)
    assert torch.equal(own.reset()["observation"], env.reset()["observation"])
    assert dataclasses.asdict(own.action_mode) == dataclasses.asdict(env.action_mode)
