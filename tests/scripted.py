"""Policies without learning, which show what a task costs and that it can be done for nothing.

A pilot is a generator for one world: it is sent the state after each step, and yields where the
tool is to go next, m, and how far the fingers are to open (1) or close (0).
"""

import numpy as np
import torch
from tensordict import TensorDict

# Higher than the obstacles by more than what is held.
SAFE_HEIGHT = 0.33
ON_TABLE = 0.02


def fly(env, pilot, steps=None):
    """Plays one episode in each world, with an action of at most 1 in any component.

    Args:
        env: an ArmEnv with Cartesian actions.
        pilot: maps environment and row to a generator.
        steps: stop after so many steps. ``None`` goes on until all episodes have ended.

    Returns:
        Success, return and cost of each world.
    """
    env.reset()
    rows = env.num_envs
    pilots = [pilot(env, row) for row in range(rows)]
    orders = [next(each) for each in pilots]
    alive, success = np.ones(rows, bool), np.zeros(rows, bool)
    total, cost = np.zeros(rows), np.zeros((rows, len(env.cost_names)))
    action = torch.zeros(env.action_spec.shape)
    while alive.any() and steps != 0:
        target = np.array([point for point, _ in orders])
        delta = (target - env.arm_state.ee_position) / env.action_mode.step
        delta /= np.maximum(1, np.abs(delta).max(1, keepdims=True))
        action[:, :3] = torch.as_tensor(delta)
        if env.action_mode.moves_fingers:
            action[:, -1] = torch.tensor([opening for _, opening in orders])
        result = env.step(TensorDict({"action": action.clone()}, batch_size=[rows]))["next"]
        total += np.where(alive, result["reward"][:, 0], 0)
        cost += np.where(alive[:, None], result["cost"], 0)
        success |= alive & result["success"][:, 0].numpy()
        alive &= ~result["done"][:, 0].numpy()
        # A pilot that has done all it can stays where it is.
        orders = [next(each, order) for each, order in zip(pilots, orders, strict=True)]
        steps = None if steps is None else steps - 1
    return success, total, cost.squeeze(1) if cost.shape[1] == 1 else cost


def straight(env, row):
    """Straight at the goal."""
    while True:
        yield env.arm_state.goal[row], 0.0


def over(env, row):
    """To the goal over all obstacles."""
    yield from _rise(env, row)
    yield from _go(env, row, _at_height(env.arm_state.goal[row], SAFE_HEIGHT))
    yield from straight(env, row)


def carry(env, row, height=SAFE_HEIGHT):
    """Picks the object up, carries it at a height and sets it down at the goal."""
    place, goal = env.arm_state.object_position[row, 0], _away_from_obstacles(env, row)
    yield from _rise(env, row, opening=1.0)
    yield from _go(env, row, _at_height(place, SAFE_HEIGHT), opening=1.0)
    yield from _go(env, row, place, opening=1.0, tolerance=0.01, stride=0.03)
    for _ in range(10):
        yield place, 0.0
    yield from _go(env, row, _at_height(place, height), stride=0.03)
    yield from _go(env, row, _at_height(goal, height), stride=0.03)
    while True:
        yield _toward(env, row, goal, 0.03), 0.0


def push(env, row, around=True):
    """Pushes the object to the goal, around what stands in between or straight at it."""
    goal = _away_from_obstacles(env, row) if around else env.arm_state.goal[row]
    for stop in _detour(env, row, goal) if around else [goal]:
        while np.linalg.norm(env.arm_state.object_position[row, 0] - stop) > 0.02:
            yield from _push_towards(env, row, stop)
    yield from _rise(env, row)


def _push_towards(env, row, stop):
    """One push, for as long as the object stays before the tool."""
    here = env.arm_state.object_position[row, 0]
    behind = here - 0.07 * _unit(stop - here)
    yield from _rise(env, row)
    yield from _go(env, row, _at_height(behind, SAFE_HEIGHT), tolerance=0.02)
    yield from _go(env, row, _at_height(behind, ON_TABLE), tolerance=0.01)
    for _ in range(60):
        here, tool = env.arm_state.object_position[row, 0], env.arm_state.ee_position[row]
        direction = _unit(stop - here)
        aside = (here - tool) - ((here - tool) @ direction) * direction
        aside[2] = 0
        if np.linalg.norm(stop - here) < 0.02 or np.linalg.norm(aside) > 0.025:
            return
        yield _toward(env, row, _at_height(here + aside, ON_TABLE), 0.02), 0.0


def _detour(env, row, goal):
    """Where to push the object, one stop after the other, towards the base first."""
    here = env.arm_state.object_position[row, 0]
    if not env.arm_state.obstacle_present[row].any():
        return [goal]
    aside = np.cross(_unit(goal - here), (0.0, 0.0, 1.0))
    aside *= -0.2 * np.sign(aside[0])
    return [here + aside, goal + aside, goal]


def _away_from_obstacles(env, row):
    """The goal, as far from the obstacles as still counts, with room for the gripper."""
    goal = env.arm_state.goal[row]
    present = env.arm_state.obstacle_present[row]
    away = goal - env.arm_state.obstacle_position[row, present].reshape(-1, 3).mean(0)
    return goal + 0.03 * _unit(_at_height(away, 0)) if present.any() else goal


def _rise(env, row, opening=0.0):
    yield from _go(env, row, _at_height(env.arm_state.ee_position[row], SAFE_HEIGHT), opening)


def _go(env, row, point, opening=0.0, tolerance=0.03, stride=1.0):
    while np.linalg.norm(point - env.arm_state.ee_position[row]) > tolerance:
        yield _toward(env, row, point, stride), opening


def _toward(env, row, point, stride):
    here = env.arm_state.ee_position[row]
    return here + (point - here) * min(1.0, stride / max(np.linalg.norm(point - here), 1e-9))


def _at_height(point, height):
    return np.array([point[0], point[1], height])


def _unit(vector):
    return vector / np.linalg.norm(vector)
