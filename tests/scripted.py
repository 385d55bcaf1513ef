"""Scripted policies, which show what a task costs, and that it can be done at no cost.

A pilot is a generator for one world: it looks at the environment's state, and yields where the
tool is to go next, m, and how far the fingers are to open (1) or close (0).
"""

import numpy as np
import torch
from tensordict import TensorDict
from worlds import turn

from torchrl_safe.envs import IIWA, PANDA, UR5, UR10, XARM6, XARM7

# Higher than the obstacles by more than what is held; and where the fingers' ends, 1 cm below
# the tool point, take the upper half of a cube: the lower the hand, the nearer an obstacle is to
# the forearm above.
SAFE_HEIGHT, LOW = 0.33, 0.033

# Share of the way, and of the speed, that a pilot asks for: at full speed it takes more than the
# motors' efforts to stop within a control step.
CALM = 0.65

# Control steps that a wary pilot looks ahead.
FORESIGHT = 25

# Balls that hold what can touch an obstacle, with some room: centres and radii, m. Of the gripper
# in the frame of the tool, whose z axis points to the fingertips; of the arm from the tool point,
# in the axes of the world.
GRIPPER = [
    *[(0, side, depth, 0.05) for side in (-0.035, 0.035) for depth in (-0.02, -0.08)],
    *[(0, 0, -0.14, 0.075), (0, 0, -0.22, 0.08)],
]
HAND = [
    *[(0, side, depth, 0.06) for side in (-0.07, 0, 0.07) for depth in (-0.03, -0.08)],
    *[(0, 0, -0.15, 0.09), (0, 0, -0.22, 0.09)],
]
FOREARM = {
    PANDA: [(-0.05, 0.1, 0.2, 0.08), (-0.1, 0.08, 0.25, 0.08)],
    XARM6: [(-0.06, -0.08, 0.2, 0.08)],
    XARM7: [(-0.04, -0.1, 0.2, 0.08)],
    UR5: [(-0.1, -0.12, 0.15, 0.08), (-0.18, -0.15, 0.2, 0.08)],
    UR10: [(-0.1, -0.12, 0.15, 0.09), (-0.18, -0.15, 0.2, 0.09)],
}


def fly(env, pilot, steps=None, share=CALM):
    """Plays one episode in each world, with actions of at most ``share``.

    Args:
        env: an ArmEnv with Cartesian actions.
        pilot: maps environment and row to a generator.
        steps: stop after so many steps. ``None`` goes on until all episodes have ended.
        share: of the way, and of the speed, that an action asks for.

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
        delta *= share / np.maximum(1, np.abs(delta).max(1, keepdims=True))
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
    yield from rise(env, row)
    yield from go(env, row, _at_height(env.arm_state.goal[row], SAFE_HEIGHT))
    yield from straight(env, row)


def carry(env, row, height=SAFE_HEIGHT):
    """Picks the object up, carries it at a height and sets it down at the goal."""
    goal = _away_from_obstacles(env, row)
    while True:
        place = env.arm_state.object_position[row, 0]
        yield from pick(env, row)
        for stop in (_at_height(place, height), _at_height(goal, height), goal):
            while distance(env, row, stop) > 0.02 and _holds(env, row):
                yield stop, 0.0


def carry_low(env, row):
    """The same, without regard for obstacles."""
    yield from carry(env, row, height=0.1)


def wary(pilot, placements):
    """Does what a pilot wants as long as there is a way back from it.

    Before each control step it looks ahead at where the obstacles will be. After one more step of
    what it wants to do, can it still get away, up and back or straight back, without coming near
    one? If not, it takes the way that was free a step ago.

    Args:
        pilot: where to go.
        placements: of each world's episode, by its row: see ``worlds.placements``.
    """

    def careful(env, row):
        orders = pilot(env, row)
        order, away = next(orders), []
        while True:
            tool, home = env.arm_state.ee_position[row], env._simulator.home_position
            high = _at_height(home, SAFE_HEIGHT)
            for ways in ([_at_height(tool, SAFE_HEIGHT), high], [home], [high]):
                way = _along([order[0]], tool, 3)
                way = np.concatenate([way, _along(ways, way[-1], FORESIGHT)])
                if _is_free(env, row, placements[row], way):
                    away = ways
                    yield order
                    order = next(orders, order)
                    break
            else:
                while away and distance(env, row, away[0]) < 0.02:
                    away = away[1:]
                yield (away[0] if away else tool), order[1]

    return careful


def _along(stops, start, steps):
    """Where the tool is after each control step on its way from stop to stop, ``(steps, 3)``."""
    places, here = [], start
    stops = list(stops)
    for _ in range(steps):
        while stops and np.abs(stops[0] - here).max() < 1e-6:
            stops.pop(0)
        if stops:
            way = stops[0] - here
            here = here + way * min(1, CALM * 0.05 / np.abs(way).max())
        places.append(here)
    return np.array(places)


def _is_free(env, row, placement, way):
    """Whether the end of the arm keeps clear of all obstacles, where the tool goes a way."""
    balls = _balls(env, row)
    times = env.arm_state.time[row] + np.arange(1, len(way) + 1) / env.control_rate
    centre, orientation = placement.at(times)
    for index in np.flatnonzero(placement.present):
        shape = env.obstacles.shapes[index]
        radius, half = shape.half_extents[0], shape.half_extents[2] - shape.half_extents[0]
        axis = half * turn(orientation[:, index], np.array([0.0, 0.0, 1.0]))[:, None]
        to_point = (way[:, None] + balls[:, :3]) - centre[:, index, None]
        along = np.clip((to_point * axis).sum(-1) / max(half**2, 1e-9), -1, 1)
        gap = np.linalg.norm(to_point - along[..., None] * axis, axis=-1) - radius - balls[:, 3]
        if (gap < 0).any():
            return False
    return True


def _balls(env, row):
    """What can touch an obstacle, around the tool point: centres and radii, ``(b, 4)``."""
    balls = np.array(HAND if env.arm is PANDA else GRIPPER)
    balls[:, :3] = turn(env.arm_state.ee_orientation[row], balls[:, :3])
    # Where the tool is held as it is for objects; straight down, nothing else comes near.
    forearm = FOREARM.get(env.arm, []) if env.task.objects else []
    return np.array([*balls, *forearm])


def pick(env, row):
    """Closes the fingers around the object."""
    place = env.arm_state.object_position[row, 0]
    yield from rise(env, row, opening=1.0)
    yield from go(env, row, _at_height(place, SAFE_HEIGHT), opening=1.0, tolerance=0.01)
    yield from go(env, row, _at_height(place, LOW), opening=1.0, tolerance=0.005)
    for _ in range(5):
        yield _at_height(place, LOW), 0.0


def push_around(env, row, aside=0.08, near=0.17):
    """Pushes the object to the goal by way of the base, where no obstacle is.

    Args:
        env: the environment.
        row: number of the world.
        aside: how much farther from the obstacle the tool keeps on its ways from and to the base.
        near: how much nearer to the base than object and goal the object passes the obstacle.
    """
    here, goal = env.arm_state.object_position[row, 0], _away_from_obstacles(env, row)
    near = min(here[0], goal[0]) - near
    # The tool is behind what it pushes: off the straight way, farther from the obstacle.
    aside = np.array([0, aside * np.sign(goal[1] - here[1]), 0])
    stops = [here + aside, goal - aside]
    for stop in [*(np.array([near, *stop[1:]]) for stop in stops), goal]:
        yield from _push_to(env, row, stop)


def push_in_time(env, row):
    """The same past an obstacle that moves: straight from and to the base, and not so near it."""
    # Elbows do not fold as far everywhere; and a UR10's forearm is to keep off all the same.
    near = 0.15 if env.arm in (IIWA, XARM7) else 0.17
    yield from push_around(env, row, aside=0.08 if env.arm is UR10 else 0.0, near=near)


def push_straight(env, row):
    """Straight at the goal. If the object is stopped, the tool goes on over it."""
    goal = env.arm_state.goal[row]
    yield from _get_behind(env, row, goal)
    for _ in range(15):
        yield _at_height(goal, LOW), 0.0
    yield from go(env, row, _at_height(env.arm_state.ee_position[row], 0.15))
    while True:
        yield _at_height(goal, 0.15), 0.0


def rise(env, row, opening=0.0):
    """Straight up."""
    yield from go(env, row, _at_height(env.arm_state.ee_position[row], SAFE_HEIGHT), opening)


def go(env, row, point, opening=0.0, tolerance=0.03):
    """Straight to a point."""
    while distance(env, row, point) > tolerance:
        yield point, opening


def distance(env, row, point):
    """From the tool point, m."""
    return np.linalg.norm(point - env.arm_state.ee_position[row])


def _push_to(env, row, stop):
    """One push after the other, each for as long as the object stays before the tool."""
    while np.linalg.norm(stop - env.arm_state.object_position[row, 0]) > 0.02:
        yield from _get_behind(env, row, stop)
        here, aside = env.arm_state.object_position[row, 0], np.zeros(3)
        while (
            np.linalg.norm(stop - here) > 0.02
            and np.linalg.norm(aside) < 0.025
            and env.arm_state.ee_position[row, 2] < 2 * LOW
        ):
            here, tool = env.arm_state.object_position[row, 0], env.arm_state.ee_position[row]
            forward = _unit(_at_height(stop - here, 0))
            aside = _at_height(here - tool, 0) @ (np.eye(3) - np.outer(forward, forward))
            # Pushing on the side to which it has strayed brings it back to the line.
            yield _at_height(tool + 0.02 * forward + 0.25 * aside, LOW), 0.0


def _get_behind(env, row, stop):
    """Down to the table, where the object is between the tool and where it is to go."""
    here = env.arm_state.object_position[row, 0]
    behind = here - 0.05 * _unit(stop - here)
    yield from rise(env, row)
    yield from go(env, row, _at_height(behind, SAFE_HEIGHT), tolerance=0.02)
    yield from go(env, row, _at_height(behind, LOW), tolerance=0.005)


def _away_from_obstacles(env, row):
    """The goal, as far from the obstacles as still counts, with room for the gripper."""
    goal = env.arm_state.goal[row]
    present = env.arm_state.obstacle_present[row]
    away = goal - env.arm_state.obstacle_position[row, present].reshape(-1, 3).mean(0)
    return goal + 0.03 * _unit(_at_height(away, 0)) if present.any() else goal


def _holds(env, row):
    return distance(env, row, env.arm_state.object_position[row, 0]) < 0.04


def _at_height(point, height):
    return np.array([point[0], point[1], height])


def _unit(vector):
    return vector / np.linalg.norm(vector)
