"""How speed grows with workers, and the cost of a step with worlds, obstacles and costs."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager
from functools import partial
from time import perf_counter
from typing import Any

import torch
from torchrl import torchrl_logger
from torchrl.collectors import BaseCollector, MultiSyncCollector
from torchrl.collectors.distributed import RayCollector

from benchmarks.report import Figure
from benchmarks.rollouts import ENDLESS, rollout
from benchmarks.timing import Contender, quartiles, race, ratio, timed
from experiments.agent import make_agent
from torchrl_safe.envs import ArmEnv, Collision, JointDelta, NoObstacles, Scattered

_RAY = {"num_cpus": 1, "num_gpus": 0, "memory": 512 * 2**20}


def make_env(worlds: int, **settings: Any) -> ArmEnv:
    """Makes an environment that is only reset by success."""
    settings = {"action": JointDelta(), "max_episode_steps": ENDLESS, **settings}
    return ArmEnv(num_envs=worlds, **settings)


@contextmanager
def collecting(collector: BaseCollector) -> Iterator[Contender]:
    """A collector's time for a batch, on the wall, since its workers are other processes."""
    batches = iter(collector)
    try:
        yield timed(lambda: next(batches), clock=perf_counter)
    finally:
        collector.shutdown()


def collector(kind: Callable[..., BaseCollector], workers: int, worlds: int) -> BaseCollector:
    """A collector whose workers share the worlds, 16 control steps at a time."""
    env = make_env(1)
    actor = make_agent(env, gamma=0.97).actor
    env.close()
    made = kind(
        [partial(make_env, worlds // workers)] * workers,
        actor,
        frames_per_batch=16 * worlds,
        total_frames=10**9,
    )
    made.update_policy_weights_(actor)  # A RayCollector asks for it.
    return made


def workers(quick: bool) -> Iterator[Figure]:
    """1 and 2 workers, and 2 actors on a Ray cluster of this machine, at 12 substeps."""
    worlds, rounds = (4, 2) if quick else (32, 25)
    kinds: dict[str, tuple[Callable[..., BaseCollector], int]] = {
        "MultiSyncCollector, 1 worker": (MultiSyncCollector, 1),
        "MultiSyncCollector, 2 workers": (MultiSyncCollector, 2),
        "RayCollector, 2 actors": (
            partial(
                RayCollector,
                sync=True,
                ray_init_config={"num_cpus": 2, "include_dashboard": False, "log_to_driver": False},
                remote_configs=_RAY,
            ),
            2,
        ),
    }
    with ExitStack() as stack:
        contenders = {
            name: stack.enter_context(collecting(collector(kind, count, worlds)))
            for name, (kind, count) in kinds.items()
        }
        times = race(contenders, rounds=rounds)
    alone = times["MultiSyncCollector, 1 worker"]
    for name, bar in (("MultiSyncCollector, 2 workers", 1.7), ("RayCollector, 2 actors", None)):
        yield ratio(f"{name} / 1 worker, wall clock", alone, times[name], at_least=bar)
    for name, seconds in times.items():
        yield quartiles(f"{name}, {worlds} worlds", 16 * worlds / seconds, "steps/s")


def costs_of_a_step(quick: bool) -> Iterator[Figure]:
    """Microseconds of a control step of 1 substep, and how they grow."""
    rounds = 2 if quick else 15
    for title, settings in _sweeps(quick).items():
        with ExitStack() as stack:
            contenders, frames = {}, {}
            for name, setting in settings.items():
                env = stack.enter_context(closing(make_env(frame_skip=1, **setting)))
                steps = 4 if quick else max(16, 1024 // env.num_envs)
                contenders[name], frames[name] = rollout(env, steps), steps * env.num_envs
            times = race(contenders, rounds=rounds)
        for name, seconds in times.items():
            yield quartiles(f"{title}: {name}", 1e6 * seconds / frames[name], "us a step")


def _sweeps(quick: bool) -> dict[str, dict[str, dict[str, Any]]]:
    worlds = 2 if quick else 32
    counts = (1, 2) if quick else (1, 2, 4, 8, 16, 32, 64)
    some = (0, 1) if quick else (0, 1, 2, 4)
    obstacles = {
        f"{count}": {
            "worlds": worlds,
            "obstacles": Scattered(count=count) if count else NoObstacles(),
        }
        for count in some
    }
    costs = {
        f"{count}": {
            "worlds": worlds,
            "costs": {f"cost_{index}": Collision() for index in range(count)},
        }
        for count in ((1, 2) if quick else (1, 2, 4, 8))
    }
    return {
        "number of worlds": {f"{count}": {"worlds": count} for count in counts},
        f"number of obstacles, {worlds} worlds": obstacles,
        f"number of costs, {worlds} worlds": costs,
    }


def run(*, quick: bool) -> list[Figure]:
    """Measures all of it."""
    torchrl_logger.setLevel("WARNING")
    torch.set_num_threads(1)
    return [*costs_of_a_step(quick), *workers(quick)]
