"""Policies that fly straight from waypoint to waypoint."""

import numpy as np
import torch
from tensordict import TensorDict


def fly(env, waypoints, tolerance=0.03):
    """Plays one episode in each world, with an action of at most 1 in any component.

    Args:
        env: an ArmEnv with Cartesian actions.
        waypoints: maps the current state to points of shape (stages, N, 3); each world goes on
            to its next one when it is nearer than the tolerance.

    Returns:
        Success, return and cost of each world.
    """
    env.reset()
    rows = env.num_envs
    stage, alive = np.zeros(rows, int), np.ones(rows, bool)
    total, cost, success = np.zeros(rows), np.zeros(rows), np.zeros(rows, bool)
    action = torch.zeros(env.action_spec.shape)
    while alive.any():
        points = waypoints(env.arm_state)
        target = points[stage, np.arange(rows)]
        delta = (target - env.arm_state.ee_position) / env.action_mode.step
        delta /= np.maximum(1, np.abs(delta).max(1, keepdims=True))
        action[:, :3] = torch.as_tensor(delta)
        result = env.step(TensorDict({"action": action.clone()}, batch_size=[rows]))["next"]
        total += np.where(alive, result["reward"][:, 0], 0)
        cost += np.where(alive, result["cost"][:, 0], 0)
        success |= alive & result["success"][:, 0].numpy()
        alive &= ~result["done"][:, 0].numpy()
        near = np.linalg.norm(target - env.arm_state.ee_position, axis=1) < tolerance
        stage = np.minimum(stage + near, len(points) - 1)
    return success, total, cost
