"""Draws starts of every registered combination, without physics: `make draws`.

Prints for each arm, task and layout how many of the draws find no room, which the environment
would draw again. Any other error ends it.
"""

import argparse
import sys
from concurrent.futures import ProcessPoolExecutor
from itertools import product

import numpy as np

from torchrl_safe.envs import ArmEnv, NoObstacles, NoRoomError
from torchrl_safe.envs.gym import ARMS, OBSTACLES, TASKS


def tool_at_home(arm):
    """Where the way to the goal begins, m, unless the task moves an object."""
    env = ArmEnv(ARMS[arm], obstacles=NoObstacles())
    env.reset()
    env.close()
    return env.arm_state.ee_position[0]


def misses(arm, task, home, layouts, draws, seed=0):
    """How many draws of the task find no room, and how many of each layout for the others."""
    rng = np.random.default_rng(seed)
    counts = dict.fromkeys(["task", *layouts], 0)
    for _ in range(draws):
        try:
            goal, objects = TASKS[task].sample(rng, ARMS[arm].goals)
        except NoRoomError:
            counts["task"] += 1
            continue
        start = objects[0] if len(objects) else home
        for name in layouts:
            try:
                OBSTACLES[name].sample(rng, start, goal)
            except NoRoomError:
                counts[name] += 1
    return counts


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--draws", type=int, default=10_000, help="of each combination")
    parser.add_argument(
        "--layouts",
        nargs="+",
        choices=list(OBSTACLES),
        default=list(OBSTACLES),
        help="as in the environments' names, '' for the default",
    )
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    homes = {arm: tool_at_home(arm) for arm in ARMS}
    with ProcessPoolExecutor(args.workers) as pool:
        futures = {
            (arm, task): pool.submit(
                misses, arm, task, homes[arm], args.layouts, args.draws, args.seed
            )
            for arm, task in product(ARMS, TASKS)
        }
        for (arm, task), future in futures.items():
            sys.stdout.write(f"{arm} {task} {future.result()}\n")
            sys.stdout.flush()


if __name__ == "__main__":
    main()
