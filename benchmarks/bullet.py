"""Control steps of ``ArmEnv`` in PyBullet against bare physics, panda-gym and the original code."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from functools import partial
from itertools import product
from typing import Any

import gymnasium
import numpy as np
import panda_gym  # noqa: F401  (registers its environments)
import torch
from torchrl.collectors import Collector
from torchrl.envs import EnvBase, GymEnv

from benchmarks.floor import Tape
from benchmarks.original import OriginalEnv
from benchmarks.report import Figure
from benchmarks.rollouts import (
    ACTIONS,
    ENDLESS,
    PANDA_GYM_EPISODE,
    PANDA_GYM_SUBSTEPS,
    Canned,
    episode,
    play,
    play_gym,
    rollout,
)
from benchmarks.timing import Contender, quartiles, race, ratio, timed
from experiments.agent import make_agent
from torchrl_safe.envs import (
    PAPER_CARTESIAN,
    PAPER_JOINT,
    ActionMode,
    ArmEnv,
    JointDelta,
    NoObstacles,
    Scene,
    paper_env,
)

_PAPER_ACTIONS: dict[str, ActionMode] = {"joint": PAPER_JOINT, "Cartesian": PAPER_CARTESIAN}
# Shares of the floor's steps/s.
_BARS = {("joint", 1): 0.5, ("joint", 12): 0.75, ("Cartesian", 1): 0.4, ("Cartesian", 12): 0.7}


def floor(env: ArmEnv, steps: int) -> Contender:
    """The physics of :func:`rollout` alone, on the same worlds."""
    tape, policy = Tape(), Canned(env, steps)
    env.set_seed(0)
    start = env.reset()
    with tape.recording():
        play(env, policy, steps, start)

    def contender() -> float:
        env.set_seed(0)
        env.reset()
        return tape.play()

    return contender


def collection(env: EnvBase, steps: int) -> Contender:
    """Steps through a collector with the policy that ``make train`` starts from."""
    actor = make_agent(env, gamma=0.97).actor
    frames = steps * env.batch_size.numel()
    batches = iter(
        Collector(
            env,
            actor,
            frames_per_batch=frames,
            total_frames=-1,
            auto_register_policy_transforms=False,
        )
    )
    return timed(lambda: next(batches))


def of_floor(quick: bool) -> Iterator[Figure]:
    """The share of the floor that a rollout of 32 worlds reaches at 12 substeps."""
    worlds, steps, rounds = (2, 4, 2) if quick else (32, 16, 9)
    for name, action in ACTIONS.items():
        with closing(ArmEnv(num_envs=worlds, action=action, max_episode_steps=ENDLESS)) as env:
            times = race({"floor": floor(env, steps), "ours": rollout(env, steps)}, rounds=rounds)
        yield ratio(
            f"{name}, substeps 12, {worlds} worlds: Bullet / its floor",
            times["floor"],
            times["ours"],
            at_least=_BARS[name, 12],
        )


def against_floor(quick: bool) -> Iterator[Figure]:
    """Rollout and collector against the bare steps of the same worlds."""
    counts, rounds = ((2,), 2) if quick else ((1, 8, 32, 64), 5)
    for (name, action), substeps, worlds in product(ACTIONS.items(), (1, 12), counts):
        steps = 8 if quick else max(16, (1024 if substeps == 1 else 256) // worlds)
        env = ArmEnv(num_envs=worlds, action=action, frame_skip=substeps, max_episode_steps=ENDLESS)
        with closing(env):
            times = race(
                {
                    "floor": floor(env, steps),
                    "rollout": rollout(env, steps),
                    "collector": collection(env, steps),
                },
                rounds=rounds,
            )
        case = f"{name}, substeps {substeps}, {worlds} worlds"
        bar = _BARS[name, substeps] if worlds == 32 else None
        yield ratio(f"{case}: rollout / floor", times["floor"], times["rollout"], at_least=bar)
        yield ratio(f"{case}: collector / floor", times["floor"], times["collector"])
        yield from (
            quartiles(f"{case}: {way}", steps * worlds / seconds, "steps/s")
            for way, seconds in times.items()
        )


def against_single_world(quick: bool) -> Iterator[Figure]:
    """The collector with 32 worlds against the collector with one."""
    worlds, steps, rounds = (4, 8, 2) if quick else (32, 128, 7)
    settings: dict[str, Any] = {"action": JointDelta(), "frame_skip": 1}
    with closing(ArmEnv(**settings)) as one, closing(ArmEnv(num_envs=worlds, **settings)) as many:
        times = race(
            {"one": collection(one, steps), "many": collection(many, steps)}, rounds=rounds
        )
    yield ratio(
        f"joint, substeps 1: collector, {worlds} worlds / 1 world",
        times["one"] * worlds,
        times["many"],
        at_least=15,
    )


def against_original(quick: bool) -> Iterator[Figure]:
    """Whole episodes of 500 steps, resets included, against the original code."""
    worlds, steps, rounds = (2, 8, 2) if quick else (32, 500, 3)
    for name in ACTIONS:
        original = OriginalEnv("joint" if name == "joint" else "cartesian")
        lean = ArmEnv(
            num_envs=worlds, action=ACTIONS[name], frame_skip=1, max_episode_steps=ENDLESS
        )
        paper = paper_env(_PAPER_ACTIONS[name], num_envs=worlds, max_episode_steps=ENDLESS)
        actions = np.random.default_rng(0).uniform(-1, 1, (steps, 7 if name == "joint" else 4))
        with closing(original), closing(lean), closing(paper):
            times = race(
                {
                    "original": timed(partial(play_gym, original.reset, original.step, actions)),
                    "lean": episode(lean, steps),
                    "paper": episode(paper, steps),
                },
                rounds=rounds,
            )
        for scene, bar in (("lean", 5), ("paper", 3)):
            yield ratio(
                f"{name}, substeps 1, {worlds} worlds: {scene} scene / original code",
                times["original"] * worlds,
                times[scene],
                at_least=bar,
            )


def against_panda_gym(quick: bool) -> Iterator[Figure]:
    """Episodes of 50 steps of 20 substeps, resets included, against PandaReach-v3."""
    worlds, rounds = (2, 2) if quick else (32, 7)
    steps = 4 if quick else PANDA_GYM_EPISODE
    settings: dict[str, Any] = {
        "num_envs": worlds,
        "obstacles": NoObstacles(),
        "frame_skip": PANDA_GYM_SUBSTEPS,
        "max_episode_steps": PANDA_GYM_EPISODE,
    }
    theirs = gymnasium.make("PandaReach-v3")
    wrapped = GymEnv("PandaReach-v3")
    lean, fingers = ArmEnv(**settings), ArmEnv(scene=Scene(free_fingers=True), **settings)
    actions = np.random.default_rng(0).uniform(-1, 1, (steps, 3)).astype(np.float32)
    with closing(theirs), closing(wrapped), closing(lean), closing(fingers):
        times = race(
            {
                "raw": timed(partial(play_gym, theirs.reset, theirs.step, actions)),
                "GymEnv": episode(wrapped, steps),
                "ArmEnv": episode(lean, steps),
                "ArmEnv with movable fingers": episode(fingers, steps),
            },
            rounds=rounds,
        )
    for name, (theirs_name, bar) in product(
        ("ArmEnv", "ArmEnv with movable fingers"), (("raw", 1.7), ("GymEnv", 2.0))
    ):
        yield ratio(
            f"Cartesian, substeps {PANDA_GYM_SUBSTEPS}, {worlds} worlds: {name} / "
            f"panda-gym, {theirs_name}",
            times[theirs_name] * worlds,
            times[name],
            at_least=bar if name == "ArmEnv" else None,
        )


def run(*, quick: bool) -> list[Figure]:
    """Measures all of it."""
    torch.set_num_threads(1)
    return [
        *against_floor(quick),
        *against_single_world(quick),
        *against_original(quick),
        *against_panda_gym(quick),
    ]
