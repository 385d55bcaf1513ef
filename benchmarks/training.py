"""Whole training, batch by batch, against Stable-Baselines3's PPO.

Stable-Baselines3 has the Gymnasium view of the same arms. Frames, minibatches, epochs and networks
(two layers of 64) are the same; PPO-Lagrangian has three networks, Stable-Baselines3 two. All have
one thread; what starting and compiling take is left out.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from functools import partial
from itertools import product
from typing import Any

import torch
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import DummyVecEnv
from torchrl import torchrl_logger

from benchmarks.report import Figure
from benchmarks.timing import Contender, quartiles, race, ratio, timed
from experiments.algorithms import ALGORITHMS
from experiments.compiling import PAYS_FROM
from experiments.config import AlgorithmName, Config
from experiments.environment import PHYSICS, make_env
from experiments.train import collecting
from torchrl_safe.envs import PAPER_JOINT, PAPER_SETTINGS, JointDelta
from torchrl_safe.envs.gym import ArmGymEnv

# Stable-Baselines3 refuses the paper's actions, which have no bound.
_BOUNDED = replace(PAPER_JOINT, bound=1e3)


@contextmanager
def ours(config: Config) -> Iterator[Contender]:
    """PPO-Lagrangian as ``make train`` trains it in one process; a turn is one batch."""
    algorithm: AlgorithmName = "ppo-lagrangian"
    torch.manual_seed(0)
    env = make_env(config, num_envs=8, seed=0, algorithm=algorithm)
    training = ALGORITHMS[algorithm].build(env, config)
    env.close()
    with collecting(config, training.collector, algorithm) as collector:
        batches = iter(collector)

        def learn() -> None:
            batch = next(batches)
            assert training.updater is not None
            training.updater.step(batch["next", "episode_cost"][batch["next", "done"].squeeze(-1)])
            training.learner.learn(batch)
            collector.update_policy_weights_()

        yield timed(learn)


@contextmanager
def stable_baselines(config: Config, envs: int) -> Iterator[Contender]:
    """Stable-Baselines3's PPO with as many frames, minibatches and epochs."""
    arm: dict[str, Any] = {"action": JointDelta(), "physics": PHYSICS[config.physics]}
    if config.paper:
        arm = {**PAPER_SETTINGS, "action": _BOUNDED}
    factory = partial(ArmGymEnv, **arm)
    vector = DummyVecEnv([factory] * envs)
    model = PPO(
        "MlpPolicy",
        vector,
        n_steps=config.frames_per_batch // envs,
        batch_size=config.minibatch,
        n_epochs=config.epochs,
        gamma=config.gamma,
        learning_rate=config.learning_rate,
        device="cpu",
    )
    try:
        yield timed(lambda: model.learn(config.frames_per_batch, reset_num_timesteps=False))
    finally:
        vector.close()


def run(*, quick: bool) -> list[Figure]:
    """Measures all of it."""
    torchrl_logger.setLevel("WARNING")
    torch.set_num_threads(1)
    rounds, worlds = (1, 2) if quick else (5, 32)
    settings: dict[str, Any] = {"frames_per_batch": 64, "minibatch": 32} if quick else {}
    counts = {f"{worlds} environments": worlds, "1 environment": 1}
    figures: list[Figure] = []
    for case, paper in (("paper's setting, 1 substep", True), ("default, 12 substeps", False)):
        config = Config(action="joint", envs=worlds, workers=1, paper=paper, **settings)
        mine = {"PPO-Lagrangian": config}
        theirs = {f"SB3, {count}": (config, n) for count, n in counts.items()}
        many = next(iter(theirs))
        bars: dict[tuple[str, str], float] = {("PPO-Lagrangian", many): 3} if paper else {}
        if not paper:
            mujoco = replace(config, physics="mujoco")
            mine["PPO-Lagrangian (MuJoCo)"] = mujoco
            if not quick:
                # As a run of at least that length does it.
                frames = PAYS_FROM * config.minibatch // config.epochs
                mine["PPO-Lagrangian (MuJoCo), compiled"] = replace(mujoco, frames=frames)
            theirs |= {f"SB3 (MuJoCo), {count}": (mujoco, n) for count, n in counts.items()}
            bars |= {(name, many): 4 for name in mine if "MuJoCo" in name}
        with ExitStack() as stack:
            contenders = {name: stack.enter_context(ours(c)) for name, c in mine.items()}
            for name, (arm, envs) in theirs.items():
                contenders[name] = stack.enter_context(stable_baselines(arm, envs))
            times = race(contenders, rounds=rounds)
        for name, other in product(mine, theirs):
            title, bar = f"{case}: {name} / {other}", bars.get((name, other))
            figures.append(ratio(title, times[other], times[name], at_least=bar))
        for name, taken in times.items():
            speed = config.frames_per_batch / taken
            figures.append(quartiles(f"{case}: {name}", speed, "frames/s"))
    return figures
