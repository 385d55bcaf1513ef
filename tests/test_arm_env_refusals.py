"""What ArmEnv refuses: arguments, actions, and what its parts return."""

import copy
import pickle
import re

import numpy as np
import pybullet
import pytest
import torch
from bullet_worlds import worlds_of
from tensordict import TensorDict

from torchrl_safe.envs import (
    ArmEnv,
    Box,
    Bullet,
    Collision,
    Cylinder,
    FullObservation,
    InFront,
    JointDelta,
    Placement,
    Push,
    Reach,
    Region,
)

HOME, TINY = [0.35, 0, 0.2], Region((0.5, -0.1, 0), (0.6, 0.1, 0))


def step(env, action):
    """Passes the action on as it is, whatever its shape."""
    return env.step(TensorDict({"action": action}, batch_size=env.batch_size))["next"]


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_action_must_be_finite(make_env, value):
    env = make_env(ArmEnv, num_envs=3, seed=0)
    env.reset()
    action = torch.zeros(3, 3)
    action[1, 2] = value
    with pytest.raises(
        ValueError, match=r"action must be finite, got NaN or infinity in rows \[1\]"
    ):
        step(env, action)


@pytest.mark.parametrize("shape", [(3, 4), (3, 1), (3,)])
def test_action_must_have_its_shape(make_env, shape):
    env = make_env(ArmEnv, num_envs=3, seed=0)
    env.reset()
    message = f"action must have shape (3, 3), got {shape}."
    with pytest.raises(ValueError, match=re.escape(message)):
        step(env, torch.zeros(shape))


def test_a_missing_action_is_named(make_env):
    env = make_env(ArmEnv, num_envs=1)
    with pytest.raises(KeyError, match="action"):
        env.step(env.reset())


class Places:
    """Two obstacles that stand wherever they are put; looked at when an episode begins."""

    shapes = (Cylinder(), Cylinder())

    def __init__(self, *places):
        self.places = np.array(places)

    def sample(self, rng, start, goal):
        return Placement(self.places)


class Task(Reach):
    """A task that returns whatever it is given."""

    def __init__(self, **values):
        super().__init__()
        self.__dict__["values"] = values

    def sample(self, rng, goals):
        goal, objects = super().sample(rng, goals)
        if "drawn" in self.values:
            return self.values["drawn"]
        return self.values.get("goal", goal), objects

    @property
    def objects(self):
        return self.values.get("objects", ())

    def reward(self, state):
        return self.values.get("reward", super().reward(state))

    def success(self, state):
        return self.values.get("success", super().success(state))


class Mode(JointDelta):
    """An action mode whose targets are those that it is given."""

    def __init__(self, bound=1.0, **values):
        super().__init__()
        self.__dict__.update(bound=bound, values=values)

    def targets(self, action, state, simulator):
        joints, fingers = super().targets(action, state, simulator)
        return self.values.get("joints", joints), self.values.get("fingers", fingers)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"num_envs": 0}, "num_envs must be a whole number of at least 1, got 0"),
        ({"num_envs": True}, "num_envs must be a whole number of at least 1, got True"),
        ({"frame_skip": 2.5}, "frame_skip must be a whole number of at least 1, got 2.5"),
        ({"max_episode_steps": -1}, "max_episode_steps must be a whole number"),
        ({"seed": -1}, "seed must be a whole number and not negative, got -1"),
        ({"seed": 1.5}, "seed must be a whole number and not negative, got 1.5"),
        ({"observation": lambda s: {}}, "observation must return at least one field"),
        ({"observation": lambda s: {"x": [1.0]}}, "observation field 'x' must have shape"),
        ({"task": Push(TINY, distance=0.16)}, "must leave free the arm at home and the objects"),
        ({"costs": {}}, "costs must name at least one cost"),
        ({"costs": {"flat": lambda state: 0.0}}, r"cost 'flat' must have shape \(1,\), got \(\)"),
        ({"costs": {"nan": lambda state: np.array([np.nan])}}, "cost 'nan' must be finite"),
        ({"task": Task(drawn=np.ones(3))}, "sample of the task must return two arrays"),
        ({"task": Task(drawn=(np.ones(3),))}, "sample of the task must return two arrays"),
        (
            {"task": Task(drawn=(np.ones(3), np.zeros((1, 3))))},
            r"objects must have shape \(0, 3\), got \(1, 3\)",
        ),
        ({"task": Task(goal=[0.6])}, r"goal must have shape \(3,\), got \(1,\)"),
        ({"task": Task(goal=[0.6, 0, np.nan])}, "goal must be finite"),
        ({"task": Task(reward=0.0)}, r"reward must have shape \(1,\), got \(\)"),
        ({"task": Task(success=[[True]])}, r"success must have shape \(1,\), got \(1, 1\)"),
        ({"task": Task(success=[0.3])}, "success must be True or False for each .* dtype float64"),
        ({"observation": lambda s: {"x": s.goal[0]}}, r"observation field 'x' must have shape"),
        ({"observation": lambda s: {"x": s.contact_distance}}, "observation field 'x' must be fin"),
        ({"obstacles": Places([0.7, 0, 0])}, r"obstacle positions must have shape \(2, 3\), got"),
        ({"obstacles": Places([0.7, 0, 0], [np.nan] * 3)}, "position must be finite"),
        ({"obstacles": Places([0.7, 0, 0], HOME)}, "must leave free the arm at home"),
        ({"action": Mode(bound=np.nan)}, "bound must be positive, got nan"),
        (
            {"action": Mode(joints=np.zeros(7))},
            "joint targets of the action must have",
        ),
        (
            {"action": Mode(fingers=np.zeros((1, 3)))},
            "finger targets of the action must have",
        ),
        ({"task": Task(objects=(Box(),))}, "objects of task must have a mass to be moved, got Box"),
        ({"obstacles": InFront(gap=0.5)}, "gap must be less than the horizontal distance"),
    ],
    ids=lambda value: next(iter(value)) if isinstance(value, dict) else "",
)
def test_bad_arguments(arguments, message):
    with pytest.raises(ValueError, match=message):
        ArmEnv(**arguments)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"arm": "panda"}, "arm must be an instance of ArmModel, got 'panda'"),
        ({"action": "cartesian"}, "action must be an instance of ActionMode, got 'cartesian'"),
        ({"task": Reach}, "task must be an instance of Task, got <class"),
        ({"task": ()}, r"got \(\), which has no objects and no reward and no sample"),
        ({"obstacles": Cylinder()}, "obstacles must be an instance of Obstacles"),
        ({"task": Task(objects=(3,))}, "objects of task must be an instance of Cyl.*, got 3"),
        ({"task": Task(objects=Box())}, "objects of task must be an instance of Sequence, got Box"),
        ({"scene": None}, "scene must be an instance of Scene, got None"),
        ({"physics": Bullet}, "physics must be an instance of Physics, got <class"),
        ({"observation": FullObservation}, "observation must be a callable object, got <class"),
        ({"observation": lambda s: s.goal}, "what observation returns must be an instance of Map"),
        ({"costs": [Collision()]}, "costs must be an instance of Mapping"),
        ({"costs": {"c": Collision}}, "cost 'c' must be a callable object, got <class"),
        ({"costs": {1: Collision()}}, r"costs must have names that are strings, got \[1\]"),
        ({"gui": "no"}, "gui must be True or False, got 'no'"),
    ],
    ids=lambda value: next(iter(value)) if isinstance(value, dict) else "",
)
def test_arguments_of_the_wrong_kind(arguments, message):
    with pytest.raises(TypeError, match=message):
        ArmEnv(**arguments)


def test_targets_that_are_not_finite_do_not_reach_the_motors(make_env):
    """PyBullet would drive all joints at full speed."""
    mode = Mode()
    env = make_env(ArmEnv, action=mode, seed=0)
    start = env.reset()
    mode.values["joints"] = np.array([[np.nan, *np.zeros(6)]])
    with pytest.raises(ValueError, match="joint targets of the action must be finite"):
        env.step(start.set("action", torch.zeros(1, 7)))
    np.testing.assert_array_equal(env.arm_state.joint_velocity, np.zeros((1, 7)))


@pytest.mark.parametrize(
    ("later", "message"),
    [
        (
            lambda s: {"goal": s.goal},
            r"observation must return the fields .*, got \{'goal'",
        ),
        (lambda s: {"tool": s.ee_position, "goal": s.goal}, "observation must return the fields"),
        (lambda s: {"goal": s.goal, "tool": s.ee_position / 0}, "field 'tool' must be finite"),
    ],
    ids=["fewer", "order", "infinite"],
)
def test_fields_of_an_observation_stay_as_they_were(make_env, later, message):
    returned = [lambda s: {"goal": s.goal, "tool": s.ee_position}]
    env = make_env(ArmEnv, observation=lambda state: returned[-1](state), seed=0)
    start = env.reset()
    returned.append(later)
    with np.errstate(divide="ignore"), pytest.raises(ValueError, match=message):
        env.step(start.set("action", torch.zeros(1, 3)))


@pytest.mark.usefixtures("engine")
@pytest.mark.parametrize(
    "name", ["joint_lower", "joint_upper", "obstacle_size", "goal", "joint_position"]
)
def test_a_state_cannot_be_changed(make_env, name):
    """Costs, tasks, observations and motors share its arrays."""
    env = make_env(ArmEnv, seed=0)
    env.reset()
    with pytest.raises(ValueError, match="read-only"):
        getattr(env.arm_state, name)[:] = 0


def test_a_mask_of_worlds_to_step_is_refused(make_env):
    env = make_env(ArmEnv, num_envs=2, seed=0)
    start = env.reset().set("action", torch.ones(2, 3))
    env.step(start.clone().set("_step", torch.tensor([True, True])))
    with pytest.raises(RuntimeError, match="all of its worlds together, but '_step' leaves some"):
        env.step(start.set("_step", torch.tensor([True, False])))


def test_a_reset_takes_no_seed(make_env):
    """It would be the same as none."""
    with pytest.raises(TypeError, match="reset takes no seed: call set_seed"):
        make_env(ArmEnv).reset(seed=3)


def test_a_step_before_the_first_reset_is_refused(make_env):
    env = make_env(ArmEnv, num_envs=2)
    action = TensorDict(action=torch.zeros(2, 3), batch_size=[2])
    with pytest.raises(RuntimeError, match="ArmEnv must be reset before its first step"):
        env.step(action)


def test_closed_environment_says_so(make_env):
    """The number of its server may belong to another environment by then."""
    closed = ArmEnv(seed=0)
    closed.reset()
    closed.close()
    other = make_env(ArmEnv, seed=0)
    other.reset()
    before = worlds_of(other)[0].read()
    for use in (lambda: step(closed, torch.ones(1, 3)), closed.reset, closed.render):
        with pytest.raises(RuntimeError, match="This ArmEnv is closed"):
            use()
    with pytest.raises(pybullet.error, match="Not connected"):
        worlds_of(closed)[0].advance([0.0] * 7, [], 12)
    assert worlds_of(other)[0].read() == before


@pytest.mark.usefixtures("engine")
@pytest.mark.parametrize("copier", [copy.deepcopy, pickle.dumps], ids=["deepcopy", "pickle"])
def test_environments_are_not_copied(make_env, copier):
    env = make_env(ArmEnv, seed=0)
    with pytest.raises(TypeError, match="cannot be copied or pickled; pass a factory"):
        copier(env)


def test_nan_cost_raises_at_the_step_where_it_appears(make_env):
    def late(state):
        moved = np.abs(state.joint_velocity).max(axis=1) > 0.01
        return np.where(moved, np.nan, 0.0)

    env = make_env(ArmEnv, costs={"late": late}, seed=0)
    env.reset()
    with pytest.raises(ValueError, match="cost 'late' must be finite"):
        step(env, torch.ones(1, 3))
