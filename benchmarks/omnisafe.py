"""Speed against OmniSafe's PPOLag: ``make bench-omnisafe``.

Collection is timed by the CPU time of a step in one environment, training by the clock: frames a
second, at the same number of gradient steps on minibatches of the same size.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from tempfile import mkdtemp
from time import perf_counter
from typing import Any

import omnisafe
import torch
import tyro

from benchmarks.report import Figure, table
from benchmarks.timing import Contender, race, ratio, timed
from experiments import safe_gym


@dataclass(frozen=True)
class Config:
    """Measure the speed of collection and training against OmniSafe's PPOLag."""

    env: str = "SafetySwimmerVelocity-v1"
    """Environment of Safety-Gymnasium."""
    rounds: int = 5
    """Turns that each contender takes."""
    frames: int = 8_000
    """Steps that are collected and learnt from in a turn of training: at least an episode in each
    of eight environments."""
    passes: int = 10
    """Passes over them."""
    minibatch: int = 64
    """Steps in a minibatch."""
    compile: bool = True
    """Compile our loss, as is the default of experiments.safe_gym."""


def make_theirs(config: Config, envs: int, frames: int) -> Any:
    """Makes OmniSafe's algorithm with its defaults but those that are the same for all."""
    agent = omnisafe.Agent(
        "PPOLag",
        config.env,
        custom_cfgs={
            "train_cfgs": {
                "total_steps": frames,
                "vector_env_nums": envs,
                "torch_threads": 1,
                "device": "cpu",
            },
            "algo_cfgs": {
                "steps_per_epoch": frames,
                "update_iters": config.passes,
                "batch_size": config.minibatch,
                "kl_early_stop": False,
            },
            "logger_cfgs": {
                "use_wandb": False,
                "use_tensorboard": False,
                "log_dir": mkdtemp(),
            },
        },
    )
    return agent.agent


def their_rollout(theirs: Any, steps: int) -> None:
    """Collects, as OmniSafe's ``learn`` does."""
    theirs._env.rollout(
        steps_per_epoch=steps,
        agent=theirs._actor_critic,
        buffer=theirs._buf,
        logger=theirs._logger,
    )


def our_config(config: Config, envs: int, frames: int) -> safe_gym.Config:
    """Our defaults but those that are the same for all."""
    return safe_gym.Config(
        env=config.env,
        envs=envs,
        frames_per_batch=frames,
        minibatch=config.minibatch,
        epochs=config.passes,
        max_kl=1e9,
        compile=config.compile,
    )


def our_batches(config: safe_gym.Config) -> tuple[safe_gym.Agent, Iterator[Any]]:
    """Our networks and collector."""
    env = safe_gym.make_env(config)
    agent = safe_gym.make_agent(env, config.log_std)
    return agent, iter(safe_gym.make_collector(config, env, agent))


def collection(config: Config) -> list[Figure]:
    """CPU time of a step in one environment."""
    steps = 1_000
    theirs = make_theirs(config, 1, steps)
    _, batches = our_batches(our_config(config, 1, steps))

    def collect_theirs() -> float:
        seconds = timed(lambda: their_rollout(theirs, steps))()
        theirs._buf.get()  # Empties it.
        return seconds

    contenders: dict[str, Contender] = {
        "OmniSafe": collect_theirs,
        "ours": timed(lambda: next(batches)),
    }
    times = race(contenders, rounds=4 * config.rounds)
    name = "CPU time of a step in one environment: ours / OmniSafe"
    return [ratio(name, times["ours"], times["OmniSafe"], at_most=1.2)]


def training(config: Config) -> list[Figure]:
    """Frames a second of a whole epoch."""

    def make_their_epoch(envs: int) -> Contender:
        theirs = make_theirs(config, envs, config.frames)

        def epoch() -> None:
            their_rollout(theirs, config.frames // envs)
            theirs._update()

        return timed(epoch, clock=perf_counter)

    def make_our_epoch(envs: int) -> Contender:
        ours = our_config(config, envs, config.frames)
        agent, batches = our_batches(ours)
        learner = safe_gym.Learner(ours, agent, batches=1_000_000)
        updater = safe_gym.make_updater(ours, learner.loss)
        assert updater is not None

        def epoch() -> None:
            batch = next(batches)
            updater.step(batch["next"][batch["next", "done"].squeeze(-1)]["episode_cost"])
            learner.learn(batch)

        return timed(epoch, clock=perf_counter)

    contenders = {
        "ours": make_our_epoch(8),
        "OmniSafe, its one environment": make_their_epoch(1),
        "OmniSafe, eight": make_their_epoch(8),
    }
    times = race(contenders, rounds=config.rounds)
    return [
        ratio(
            f"frames a second in training: ours, eight / {name}",
            times[name],
            times["ours"],
            at_least=2.0,
        )
        for name in contenders
        if name != "ours"
    ]


def main(config: Config) -> None:
    """Prints the figures."""
    torch.set_num_threads(1)
    for measure in (collection, training):
        print(table(measure(config)), flush=True)


if __name__ == "__main__":
    main(tyro.cli(Config))
