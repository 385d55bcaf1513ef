"""For the tests that need the simulator: steps, layouts, and an arm that is simple to compute.

The turntable is a bar that turns about a vertical axis: 1 m long, 0.1 m wide, 0.04 m thick, its
middle at (0, 0, 0.5) m. Its tool point is the end that points along x at home.
"""

import itertools

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from torchrl_safe.envs import (
    ArmModel,
    Bullet,
    JointDelta,
    MuJoCo,
    NoObstacles,
    Placement,
    Reach,
    Region,
    gym,
)

ENGINES = {"bullet": Bullet(), "mujoco": MuJoCo(threads=1)}
ARMS = {name.lower(): arm for name, arm in gym.ARMS.items()}


def combinations(*choices):
    """All combinations as parameters; each pair of choices is in one that is not slow."""
    names = list(itertools.product(*choices))
    fast = set(_with_every_pair(names))
    return [
        pytest.param(*one, id="-".join(one), marks=[] if one in fast else [pytest.mark.slow])
        for one in names
    ]


def _with_every_pair(combinations):
    """Takes the combination with most pairs that are still missing, until none is."""

    def pairs(combination):
        return set(itertools.combinations(enumerate(combination), 2))

    missing = set().union(*map(pairs, combinations))
    while missing:
        chosen = max(combinations, key=lambda one: len(pairs(one) & missing))
        missing -= pairs(chosen)
        yield chosen


each_arm = pytest.mark.parametrize("arm", ARMS.values(), ids=ARMS.keys())

_TURNTABLE = """
<robot name="turntable">
  <link name="post">
    <inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>
    <collision><origin xyz="0 0 0.2"/><geometry><box size="0.1 0.1 0.4"/></geometry></collision>
  </link>
  <joint name="turn" type="revolute">
    <parent link="post"/><child link="bar"/><origin xyz="0 0 0.5"/><axis xyz="0 0 1"/>
    <limit lower="-1" upper="1" effort="100" velocity="10"/>
  </joint>
  <link name="bar">
    <inertial><mass value="2"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>
    <collision><geometry><box size="1 0.1 0.04"/></geometry></collision>
  </link>
  <joint name="end" type="fixed">
    <parent link="bar"/><child link="tool"/><origin xyz="0.5 0 0"/>
  </joint>
  <link name="tool">
    <inertial>
      <mass value="0.1"/><inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/>
    </inertial>
  </link>
</robot>
"""


def turntable_settings(folder):
    """Settings of an ArmEnv with a turntable, which draws goals where the tool is."""
    file = folder / "turntable.urdf"
    file.write_text(_TURNTABLE)
    arm = ArmModel(str(file), "tool", home=(0.0,), goals=Region((0.5, 0, 0.5), (0.5, 0, 0.5)))
    return {
        "arm": arm,
        "action": JointDelta(step=0.1, respect_limits=False),
        "task": Reach(radius=1e-9),
        "obstacles": NoObstacles(),
        "max_episode_steps": 1000,
        "seed": 0,
    }


class Places:
    """A layout of obstacles that stand wherever they are put, and move as they are told."""

    def __init__(self, *shapes, at, orientation=None, present=None, path=None):
        self.shapes = shapes
        self.placement = Placement(np.array(at, float), orientation, present, path)

    def sample(self, rng, start, goal):
        return self.placement


def at_speed(start, velocity):
    """The path of one obstacle from a place, m, at a velocity, m/s; it does not turn."""

    def path(times):
        positions = np.array(start) + times[:, None, None] * velocity
        return positions, np.tile([0.0, 0.0, 0.0, 1.0], (len(times), 1, 1))

    return path


def step(env, action):
    """The results of an action, given for one world or for each."""
    action = torch.as_tensor(action, dtype=torch.float32).expand(env.action_spec.shape)
    return env.step(TensorDict({"action": action}, batch_size=env.batch_size))["next"]


def placements(env):
    """The placement of each world's episode, by its row, from the next resets on."""
    noted, reset = {}, env._simulator.reset

    def note(row, placement, *others):
        noted[row] = placement
        reset(row, placement, *others)

    env._simulator.reset = note
    return noted


def rest(env, steps=1):
    """The results of the last of some steps in which the arm is to stay where it is."""
    for _ in range(steps):
        result = step(env, 0.0)
    return result


def turn_back(orientation, vector):
    """Vectors as seen in frames of the given orientations, by the matrix of a quaternion."""
    x, y, z, w = np.moveaxis(np.asarray(orientation, float), -1, 0)
    matrix = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
    return np.einsum("ij...,...i->...j", matrix, vector)


def turn(orientation, vector):
    """Vectors turned by quaternions (x, y, z, w)."""
    return turn_back(np.asarray(orientation) * (-1, -1, -1, 1), vector)


def home_of(arm):
    """The tool point at home, m."""
    x = {"panda": 0.35, "iiwa": 0.42, "xarm6": 0.25, "xarm7": 0.25, "ur5": 0.35, "ur10": 0.35}
    name = next(name for name, each in ARMS.items() if each is arm)
    return np.array([x[name], 0.0, 0.25 if name == "iiwa" else 0.2])
