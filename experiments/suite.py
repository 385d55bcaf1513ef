"""The suite: ten tasks with their limits, every seed, one multiplier rule: ``make suite``.

Trains each task with the settings of its kind (``experiments.config.KINDS``). To resume it, repeat
the command: it runs what is missing.
"""

from __future__ import annotations

import dataclasses
from itertools import product
from pathlib import Path
from typing import Any, get_args

import matplotlib.pyplot as plt
import tyro

from experiments import train
from experiments.config import (
    AlgorithmName,
    Config as TrainConfig,
    Engine,
    SuiteTaskName,
    suite_config,
)
from experiments.environment import PHYSICS
from experiments.gallery import WITH_PERSON
from experiments.grid import check_grid, run_grid, save_results
from experiments.suite_report import draw
from torchrl_safe._checks import check_count
from torchrl_safe._cores import cores
from torchrl_safe.envs import SUITE


@dataclasses.dataclass(frozen=True)
class Config:
    """Train on every task of the suite and see whether the limits are kept."""

    tasks: tuple[SuiteTaskName, ...] = get_args(SuiteTaskName)
    """What to train on."""
    algorithms: tuple[AlgorithmName, ...] = ("ppo", "ppo-lagrangian")
    """What to train."""
    seeds: tuple[int, ...] = (0, 1, 2, 3, 4)
    """Seeds of the runs. Settings were found on others, from 10."""
    physics: Engine = "mujoco"
    """Engine that simulates the arm; bullet takes several times as long."""
    frames: int | None = None
    """Control steps to train for; by default as many as each task has."""
    eval_episodes: int = 256
    """Episodes of the final evaluation of each run, with the deterministic policy."""
    jobs: int = cores()
    """Runs side by side."""
    out: Path = Path("runs/suite")
    """Folder of results; runs that are already there are not run again."""

    def __post_init__(self) -> None:
        check_grid(self, "tasks", "algorithms", "seeds")
        for task, algorithm in product(self.tasks, self.algorithms):
            suite_config(task, algorithms=(algorithm,))  # Raises if it cannot be trained there.
        if self.frames is not None:
            check_count(frames=self.frames)
        check_count(least=2, eval_episodes=self.eval_episodes)


def folder(out: Path, task: str, seed: int) -> Path:
    """Where the runs of a task and a seed leave their checkpoints and policies."""
    return out / "runs" / task / str(seed)


def run(config: TrainConfig, algorithm: AlgorithmName, definition: str) -> dict[str, Any]:
    """One run. The definition of its task is kept with it: another one's results are refused."""
    return train.run(config, algorithm)


def jobs(config: Config) -> dict[Path, tuple[TrainConfig, AlgorithmName, str]]:
    """What to run, by the file of its results: all tasks of one seed after the other."""
    frames = {} if config.frames is None else {"frames": config.frames}
    return {
        config.out / f"{task}-{algorithm}-{seed}.json": (
            suite_config(
                task,
                **frames,
                physics=config.physics,
                seed=seed,
                eval_episodes=config.eval_episodes,
                workers=1,
                out=folder(config.out, task, seed),
                resume=True,
            ),
            algorithm,
            repr(SUITE[task]),
        )
        for seed, task, algorithm in product(config.seeds, config.tasks, config.algorithms)
    }


def draw_scenes(config: Config) -> None:
    """Saves a picture of each task: the first world of a seed, some control steps after a reset."""
    pictures = config.out / "pictures"
    pictures.mkdir(parents=True, exist_ok=True)
    for name in config.tasks:
        physics = PHYSICS[config.physics]
        env = SUITE[name].make_env(physics=physics, seed=1)
        env.rollout(10, lambda td: td.set("action", env.action_spec.zero()))  # noqa: B023
        plt.imsave(pictures / f"{name}.png", env.render(480, 360, WITH_PERSON)[0].numpy())
        env.close()


def main(config: Config) -> None:
    """Runs what is missing, then writes tables, figures and results.json."""
    grid = jobs(config)
    results = run_grid(run, grid, workers=config.jobs, name="suite")
    runs = [
        {"task": settings.suite_task, "algorithm": algorithm, "seed": settings.seed, **result}
        for (settings, algorithm, _), result in zip(grid.values(), results, strict=True)
    ]
    save_results(config.out, config, runs, draw(runs, config.out))
    draw_scenes(config)


if __name__ == "__main__":
    main(tyro.cli(Config))
