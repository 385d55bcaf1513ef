"""Hand-made states for the tests of costs and tasks."""

import numpy as np

from torchrl_safe.envs import ArmState
from torchrl_safe.envs.state import Trace


def make_state(**changes):
    """An ArmState of two worlds with one obstacle, with the given fields changed."""
    fields = {
        "joint_position": np.zeros((2, 7)),
        "joint_velocity": np.zeros((2, 7)),
        "joint_lower": np.full(7, -2.0),
        "joint_upper": np.full(7, 2.0),
        "finger_position": np.zeros((2, 0)),
        "ee_position": np.zeros((2, 3)),
        "ee_orientation": np.tile([0.0, 0.0, 0.0, 1.0], (2, 1)),
        "ee_velocity": np.zeros((2, 3)),
        "goal": np.ones((2, 3)),
        **bodies("object", 1),
        **bodies("obstacle", 1),
        "obstacle_present": np.ones((2, 1), bool),
        "obstacle_size": np.ones((1, 3)),
        "contact_distance": np.full((2, 1), np.inf),
        "contact_force": np.zeros((2, 1)),
        "step": np.zeros(2, int),
        "time": np.zeros(2),
    }
    arrays = {k: v if k in ("trace", "previous") else np.asarray(v) for k, v in changes.items()}
    return ArmState(**{**fields, **arrays})


def make_trace(**measurements):
    """What a state records of each substep."""
    return Trace({name: np.asarray(values, float) for name, values in measurements.items()})


def bodies(kind, count):
    """Bodies of two worlds that stand at the origin."""
    return {
        f"{kind}_position": np.zeros((2, count, 3)),
        f"{kind}_orientation": np.tile([0.0, 0.0, 0.0, 1.0], (2, count, 1)),
        f"{kind}_velocity": np.zeros((2, count, 3)),
        f"{kind}_angular_velocity": np.zeros((2, count, 3)),
    }
