"""Resets of ``ArmEnv`` against loading the world anew."""

from __future__ import annotations

from contextlib import closing
from functools import partial

import torch
from tensordict import TensorDictBase

from benchmarks.original import OriginalEnv
from benchmarks.report import Figure
from benchmarks.timing import quartiles, race, ratio, timed
from torchrl_safe.envs import ArmEnv, paper_env

# Longest reset of a world, ms.
_BAR = 1.0


def reset_row(env: ArmEnv, state: TensorDictBase) -> None:
    """Resets the rows that ``_reset`` names; TorchRL takes that key out of what it is given."""
    env.reset(state.copy())


def run(*, quick: bool) -> list[Figure]:
    """Measures all of it."""
    torch.set_num_threads(1)
    worlds, calls, rounds = (2, 1, 2) if quick else (32, 5, 25)
    figures: list[Figure] = []
    for scene, make in (("lean scene", ArmEnv), ("paper scene", paper_env)):
        env, original = make(num_envs=worlds), OriginalEnv("joint")
        with closing(env), closing(original):
            row = env.reset()
            row["_reset"] = torch.arange(worlds)[:, None] == 0
            times = race(
                {
                    "all": timed(env.reset, calls=calls),
                    "one row": timed(partial(reset_row, env, row), calls=calls),
                    "reload": timed(original.reset),
                },
                rounds=rounds,
            )
        figures += [
            quartiles(
                f"{scene}, {worlds} worlds: reset of all, for each world",
                1e3 * times["all"] / worlds,
                "ms",
                at_most=_BAR,
            ),
            quartiles(f"{scene}: reset of one row", 1e3 * times["one row"], "ms", at_most=_BAR),
            quartiles(f"{scene}: reload", 1e3 * times["reload"], "ms"),
            ratio(f"{scene}: reload / reset of one row", times["reload"], times["one row"]),
        ]
    return figures
