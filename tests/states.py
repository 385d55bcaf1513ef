"""Hand-made states for the tests of costs and tasks."""

import numpy as np

from torchrl_safe.envs import ArmState


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
        "obstacle_position": np.zeros((2, 1, 3)),
        "obstacle_velocity": np.zeros((2, 1, 3)),
        "obstacle_size": np.ones((1, 3)),
        "contact_distance": np.full((2, 1), np.inf),
    }
    return ArmState(**{**fields, **{k: np.asarray(v, float) for k, v in changes.items()}})
