"""Tries to make a shielded arm touch something: `make attack ARGS="--steps 1000000"`.

Prints for each arm, action, layout and kind of attack how often it succeeded. A touch is the arm's
own doing if its closest point was moving towards the obstacle's at that moment. To resume it,
repeat the command: it runs the attacks that are missing.
"""

import argparse
import json
import sys
from itertools import product
from pathlib import Path

import numpy as np
import torch
from tensordict import TensorDict

from torchrl_safe.envs import (
    ArmEnv,
    Bullet,
    CartesianDelta,
    Collision,
    Human,
    InFront,
    JointDelta,
    Moving,
    MuJoCo,
    Proximity,
    Scattered,
    Shield,
)
from torchrl_safe.envs.gym import ARMS

ACTIONS = {"joint": JointDelta(), "cartesian": CartesianDelta()}
FIXED = {"in-front": InFront(), "scattered": Scattered()}
MOVING = {"moving": Moving(), "human": Human()}
PHYSICS = {"bullet": Bullet(), "mujoco": MuJoCo(threads=1)}
COSTS = {"touch": Collision(table=True), "near": Proximity()}
# Slower than that the arm does not move into anything, m/s.
_AT_REST = 0.02


class Tally:
    """Counts what happens to the arm of an environment.

    Attributes:
        steps: control steps.
        touches: those in which the arm touched an obstacle, and those in which it was its doing.
        nearest: smallest distance from an obstacle at the end of a control step, m.
    """

    def __init__(self, env):
        self.env, self.nearest = env, np.inf
        self.steps = self.touches = self.own = self.table = self.braked = 0

    def note(self):
        state = self.env.arm_state
        touch = state.trace["clearance"] <= 0
        own = touch & (state.trace["arm_approach"] > _AT_REST)
        self.steps += len(touch)
        self.touches += int((touch.any(axis=(1, 2)) | (state.contact_distance <= 0).any(1)).sum())
        self.own += int(own.any(axis=(1, 2)).sum())
        self.table += int((state.trace["table_distance"] <= 0).any(axis=1).sum())
        self.braked += int(state.shield_braked.sum())
        self.nearest = min(self.nearest, state.trace["clearance"][:, -1].min(initial=np.inf))

    def figures(self):
        """What has been counted, by name."""
        names = ("steps", "touches", "own", "table", "braked", "nearest")
        return {name: float(getattr(self, name)) for name in names}

    def __str__(self):
        return describe([self.figures()])


def describe(figures):
    """Some tallies in a sentence."""
    sums = {name: sum(each[name] for each in figures) for name in figures[0]}
    return (
        f"{sums['steps']:.0f} steps, {sums['touches']:.0f} touches, {sums['own']:.0f} of its own "
        f"doing, {sums['table']:.0f} of the table, {sums['braked']:.0f} braked, nearest "
        f"{min(each['nearest'] for each in figures):.4f} m"
    )


def random(env, rng):
    """Any action."""
    return rng.uniform(-1, 1, env.action_spec.shape)


def corners(env, rng):
    """The largest actions, each component in the same direction for a while."""
    shape, state = env.action_spec.shape, env.arm_state
    before = getattr(env, "before", None)
    new = rng.choice([-1.0, 1.0], shape)
    change = rng.random(shape) < 0.15
    env.before = (
        new if before is None else np.where(change | (state.step == 0)[:, None], new, before)
    )
    return env.before


def greedy(env, rng):
    """Straight at the nearest obstacle with whatever is nearest, now and then disturbed."""
    state = env.arm_state
    rows = np.arange(len(state.joint_position))
    near = env._simulator.nearest(rows, state.joint_position, state.finger_position)
    table = state.obstacle_position.shape[1]
    nearest = np.where(near.other < table, near.distance, np.inf).argmin(axis=1)
    way = -near.jacobian[rows, nearest][:, : state.joint_position.shape[1]]
    if isinstance(env.action_mode, CartesianDelta):
        way = (env._simulator.jacobian(state.joint_position)[:, :3] @ way[:, :, None])[:, :, 0]
        action = way / np.maximum(np.abs(way).max(axis=1, keepdims=True), 1e-9)
    else:
        action = np.sign(way)
    return np.where(rng.random((len(rows), 1)) < 0.25, rng.choice([-1.0, 1.0], way.shape), action)


ATTACKS = {"random": random, "corners": corners, "greedy": greedy}


def play(env, attack, steps, seed=0):
    """Plays an attack for some steps of all worlds; returns the tally."""
    rng, tally = np.random.default_rng(seed), Tally(env)
    env.reset()
    for _ in range(steps):
        after = act(env, attack(env, rng))
        tally.note()
        if after["done"].any():
            env.reset(TensorDict({"_reset": after["done"].clone()}, batch_size=env.batch_size))
    return tally


def evolve(env, generations, length, seed=0):
    """Searches the sequence of actions that comes nearest, by the cross-entropy method.

    The worlds are one generation: begin all episodes alike. Returns the tally.
    """
    rng, tally = np.random.default_rng(seed), Tally(env)
    shape = (length, env.action_spec.shape[1])
    mean, spread = np.zeros(shape), np.ones(shape)
    for _ in range(generations):
        env.reset()
        actions = np.clip(mean + spread * rng.standard_normal((env.num_envs, *shape)), -1, 1)
        score = np.full(env.num_envs, np.inf)
        for action in actions.transpose(1, 0, 2):
            act(env, action)
            tally.note()
            state = env.arm_state
            rows = np.arange(env.num_envs)
            near = env._simulator.nearest(rows, state.joint_position, state.finger_position)
            obstacle = near.other < state.obstacle_position.shape[1]
            distance = np.where(obstacle, near.distance, np.inf).min(axis=1)
            score = np.minimum(score, np.minimum(distance, state.contact_distance.min(axis=1)))
        best = actions[score.argsort()[: max(2, env.num_envs // 8)]]
        mean, spread = best.mean(axis=0), best.std(axis=0) + 0.1
    return tally


def act(env, action):
    """The results of actions, ``(N, width)``."""
    action = torch.as_tensor(action, dtype=torch.float32)
    return env.step(TensorDict({"action": action}, batch_size=env.batch_size))["next"]


def make(arm, action, obstacles, physics, num_envs, **settings):
    """A shielded environment that measures what a tally notes."""
    fixed = {"action": action, "obstacles": obstacles, "physics": physics, "num_envs": num_envs}
    return ArmEnv(arm, **{"costs": COSTS, "shield": Shield(), "seed": 0, **fixed, **settings})


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=1_000_000, help="control steps altogether")
    parser.add_argument("--envs", type=int, default=64, help="worlds side by side")
    parser.add_argument("--physics", choices=PHYSICS, default="mujoco")
    parser.add_argument("--arms", nargs="+", choices=ARMS, default=list(ARMS))
    parser.add_argument("--layouts", nargs="+", choices={**FIXED, **MOVING}, default=list(FIXED))
    parser.add_argument("--obstacle-speed", type=float, help="that the shield expects, m/s")
    parser.add_argument(
        "--obstacle-acceleration", type=float, default=0.0, help="that the shield expects, m/s^2"
    )
    parser.add_argument(
        "--tool-weight", type=float, default=Shield.tool_weight, help="of the shield, rad/m"
    )
    parser.add_argument("--out", type=Path, default=Path("runs/attack.json"), help="what is done")
    options = parser.parse_args()
    torch.set_num_threads(1)
    layouts = {**FIXED, **MOVING}
    cases = list(product(options.arms, ACTIONS, options.layouts, ATTACKS))
    each = -(-options.steps // (len(cases) * options.envs))
    done = json.loads(options.out.read_text()) if options.out.exists() else {}
    options.out.parent.mkdir(parents=True, exist_ok=True)
    shield = Shield(
        obstacle_speed=options.obstacle_speed,
        obstacle_acceleration=options.obstacle_acceleration,
        tool_weight=options.tool_weight,
    )
    names = [
        f"{options.physics} {arm} {action} {layout} {attack}, {each} x {options.envs}, {shield}"
        for arm, action, layout, attack in cases
    ]
    for seed, (name, (arm, action, layout, attack)) in enumerate(zip(names, cases, strict=True)):
        if name not in done:
            env = make(
                ARMS[arm],
                ACTIONS[action],
                layouts[layout],
                PHYSICS[options.physics],
                options.envs,
                seed=seed,
                shield=shield,
            )
            done[name] = play(env, ATTACKS[attack], each, seed).figures()
            env.close()
            options.out.write_text(json.dumps(done, indent=1))
        sys.stdout.write(f"{arm} {action} {layout} {attack}: {describe([done[name]])}\n")
        sys.stdout.flush()
    sys.stdout.write(f"all: {describe([done[name] for name in names])}\n")


if __name__ == "__main__":
    main()
