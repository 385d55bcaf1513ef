"""Control steps in MuJoCo against PyBullet, a bare batch of MuJoCo and panda-gym."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, closing
from functools import partial
from itertools import product
from time import perf_counter
from typing import Any

import gymnasium
import numpy as np
import panda_gym  # noqa: F401  (registers its environments)
import torch

from benchmarks import bullet
from benchmarks.anatomy import anatomy
from benchmarks.bare import bare_batch, torchrl_alone
from benchmarks.report import Figure
from benchmarks.rollouts import (
    ACTIONS,
    ENDLESS,
    PANDA_GYM_EPISODE,
    PANDA_GYM_SUBSTEPS,
    episode,
    play_gym,
    rollout,
)
from benchmarks.timing import quartiles, race, ratio, timed
from torchrl_safe.envs import (
    ArmEnv,
    Bullet,
    Human,
    MuJoCo,
    NoObstacles,
    Physics,
    Shield,
    SpeedAndSeparation,
)

_AT_LEAST = {1: 4.0, 12: 3.0}


def against_bullet(quick: bool) -> Iterator[Figure]:
    """Rollouts of both, and of MuJoCo alone; processor time of one thread."""
    worlds, rounds = (2, 2) if quick else (128, 9)
    for (name, action), substeps in product(ACTIONS.items(), (12, 1)):
        steps = 4 if quick else (32 if substeps == 1 else 16)
        make = partial(
            ArmEnv,
            num_envs=worlds,
            action=action,
            frame_skip=substeps,
            max_episode_steps=ENDLESS,
        )
        with closing(make(physics=Bullet())) as theirs, closing(make(physics=MuJoCo(1))) as ours:
            times = race(
                {
                    "Bullet": rollout(theirs, steps),
                    "MuJoCo": rollout(ours, steps),
                    "bare batch": bare_batch(ours, steps),
                },
                rounds=rounds,
            )
        case = f"{name}, substeps {substeps}, {worlds} worlds"
        yield ratio(
            f"{case}: MuJoCo / Bullet",
            times["Bullet"],
            times["MuJoCo"],
            at_least=_AT_LEAST[substeps],
        )
        if substeps == 12:
            yield ratio(
                f"{case}: MuJoCo / its bare batch",
                times["bare batch"],
                times["MuJoCo"],
                at_least=0.6,
            )
        yield from (
            quartiles(f"{case}: {engine}", steps * worlds / times[engine], "steps/s")
            for engine in ("Bullet", "MuJoCo")
        )


def parts_of_a_step(quick: bool) -> Iterator[Figure]:
    """What a step costs beside physics, and where its time goes."""
    worlds, steps, rounds = (2, 4, 3) if quick else (128, 16, 9)
    for name, action in ACTIONS.items():
        settings: dict[str, Any] = {"action": action, "max_episode_steps": ENDLESS}
        with closing(ArmEnv(num_envs=worlds, physics=MuJoCo(1), **settings)) as env:
            alone = torchrl_alone(env, steps)
            turns = [(anatomy(env, steps), alone()) for _ in range(rounds)][1:]
            runs, floor = zip(*turns, strict=True)
        times = {part: 1e3 * np.array([run[part] for run in runs]) for part in runs[0]}
        case = f"{name}, substeps 12, {worlds} worlds, a step of MuJoCo"
        beside = sum(times.values()) - times["physics"]
        yield quartiles(f"{case} beside physics", beside, "ms", at_most=1)
        floor_name = f"{name}, substeps 12, {worlds} worlds, a step of an empty environment"
        yield quartiles(f"{floor_name} beside physics", 1e3 * np.array(floor), "ms")
        yield from (quartiles(f"{case}: {part}", spent, "ms") for part, spent in times.items())


def on_two_threads(quick: bool) -> Iterator[Figure]:
    """By the clock on the wall: needs two cores that are free."""
    worlds, steps, rounds = (2, 4, 2) if quick else (128, 16, 9)
    for name, action in ACTIONS.items():
        make = partial(ArmEnv, num_envs=worlds, action=action, max_episode_steps=ENDLESS)
        with closing(make(physics=Bullet())) as theirs, closing(make(physics=MuJoCo(2))) as ours:
            times = race(
                {
                    "Bullet": rollout(theirs, steps, clock=perf_counter),
                    "MuJoCo": rollout(ours, steps, clock=perf_counter),
                },
                rounds=rounds,
            )
        yield ratio(
            f"{name}, substeps 12, {worlds} worlds, wall: MuJoCo on two threads / Bullet",
            times["Bullet"],
            times["MuJoCo"],
            at_least=5,
        )


def what_costs_cost(quick: bool) -> Iterator[Figure]:
    """A person with speed and separation monitoring, and a cylinder that is not to be touched."""
    worlds, steps, rounds = (2, 4, 2) if quick else (128, 16, 9)
    make = partial(ArmEnv, num_envs=worlds, physics=MuJoCo(1), max_episode_steps=ENDLESS)
    costs = {"separation": SpeedAndSeparation()}
    with closing(make()) as plain, closing(make(obstacles=Human(), costs=costs)) as human:
        times = race(
            {"plain": rollout(plain, steps), "human": rollout(human, steps)}, rounds=rounds
        )
    yield ratio(
        f"substeps 12, {worlds} worlds: Human, SpeedAndSeparation / InFront, Collision (time)",
        times["human"],
        times["plain"],
        at_most=2,
    )


def what_a_shield_costs(quick: bool) -> Iterator[Figure]:
    """The same random actions with a shield and without, beside one obstacle."""
    worlds, steps, rounds = (2, 4, 2) if quick else (32, 16, 9)
    engines: dict[str, Physics] = {"MuJoCo": MuJoCo(1), "Bullet": Bullet()}
    shields = {"none": None, "shield": Shield()}
    for (name, action), (engine, physics) in product(ACTIONS.items(), engines.items()):
        make = partial(
            ArmEnv,
            num_envs=worlds,
            action=action,
            physics=physics,
            max_episode_steps=ENDLESS,
        )
        with ExitStack() as open_:
            rollouts = {
                label: rollout(open_.enter_context(closing(make(shield=shield))), steps)
                for label, shield in shields.items()
            }
            times = race(rollouts, rounds=rounds)
        yield ratio(
            f"{name}, substeps 12, {worlds} worlds, {engine}: shield / none (time)",
            times["shield"],
            times["none"],
            at_most=1.5,
        )


def against_panda_gym(quick: bool) -> Iterator[Figure]:
    """Episodes of 50 steps of 20 substeps, resets included, against PandaReach-v3."""
    worlds, rounds = (2, 2) if quick else (128, 5)
    steps = 4 if quick else PANDA_GYM_EPISODE
    theirs = gymnasium.make("PandaReach-v3")
    ours = ArmEnv(
        num_envs=worlds,
        physics=MuJoCo(1),
        obstacles=NoObstacles(),
        frame_skip=PANDA_GYM_SUBSTEPS,
        max_episode_steps=PANDA_GYM_EPISODE,
    )
    actions = np.random.default_rng(0).uniform(-1, 1, (steps, 3)).astype(np.float32)
    with closing(theirs), closing(ours):
        times = race(
            {
                "panda-gym": timed(partial(play_gym, theirs.reset, theirs.step, actions)),
                "MuJoCo": episode(ours, steps),
            },
            rounds=rounds,
        )
    yield ratio(
        f"Cartesian, substeps {PANDA_GYM_SUBSTEPS}, {worlds} worlds: MuJoCo / panda-gym, raw",
        times["panda-gym"] * worlds,
        times["MuJoCo"],
        at_least=5,
    )


def run(*, quick: bool) -> list[Figure]:
    """Measures all of it."""
    torch.set_num_threads(1)
    return [
        *against_bullet(quick),
        *on_two_threads(quick),
        *parts_of_a_step(quick),
        *against_panda_gym(quick),
        *what_costs_cost(quick),
        *what_a_shield_costs(quick),
        *bullet.of_floor(quick),
    ]
