"""Every algorithm on the same task: ``make compare``.

Trains each as ``make train`` does, for several seeds. All have the same settings, except those that
an algorithm has of its own in ``experiments/algorithms.py``. To resume it, repeat the command: it
runs what is missing.
"""

from __future__ import annotations

import dataclasses
from itertools import product
from pathlib import Path
from statistics import fmean
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import tyro

from experiments import train
from experiments.algorithms import ALGORITHMS, configured
from experiments.config import SHIELDED, Action, AlgorithmName, Config as TrainConfig, Engine
from experiments.grid import check_grid, run_grid, save_results
from experiments.report import episode_costs, mean_over_seeds, seeds_within
from experiments.style import LIGHT, colour, cost_axis, figure_style, label, limit_line
from experiments.tables import each, markdown
from torchrl_safe._cores import cores
from torchrl_safe.metrics import worst_seed

#: Limits of what keeps to a budget in every episode: with a limit below one touch the first touch
#: would exceed it, and the policy would learn to stay away from the target.
BUDGETS: dict[AlgorithmName, float] = {"ppo-saute": 2.0, "ppo-early-termination": 2.0}
#: Not those with a shield, which touch nothing.
COMPARED: tuple[AlgorithmName, ...] = tuple(name for name in ALGORITHMS if name not in SHIELDED)


@dataclasses.dataclass(frozen=True)
class Config:
    """Train every algorithm and compare them."""

    algorithms: tuple[AlgorithmName, ...] = COMPARED
    """What to train."""
    action: Action = "cartesian"
    """What an action moves."""
    physics: Engine = "mujoco"
    """Engine that simulates the arm; bullet takes several times as long."""
    cost_limit: float = TrainConfig.cost_limit
    """Limit of the expected cost of an episode; budgets of single episodes are at least 2."""
    seeds: tuple[int, ...] = (0, 1, 2, 3, 4)
    """Seeds of the runs."""
    frames: int = TrainConfig.frames
    """Control steps to train for."""
    eval_episodes: int = 256
    """Episodes of the final evaluation of each run, with the deterministic policy."""
    jobs: int = cores()
    """Runs side by side."""
    out: Path = Path("runs/compare")
    """Folder of results; runs that are already there are not run again."""

    def __post_init__(self) -> None:
        check_grid(self, "algorithms", "seeds")


def jobs(config: Config) -> dict[Path, tuple[TrainConfig, AlgorithmName]]:
    """What to run, by the file of its results."""
    return {
        config.out / f"{algorithm}-{seed}.json": (
            configured(
                TrainConfig(
                    action=config.action,
                    physics=config.physics,
                    cost_limit=max(config.cost_limit, BUDGETS.get(algorithm, 0.0)),
                    seed=seed,
                    frames=config.frames,
                    eval_episodes=config.eval_episodes,
                    workers=1,
                    out=config.out / "runs" / str(seed),
                    resume=True,
                ),
                algorithm,
            ),
            algorithm,
        )
        for seed, algorithm in product(config.seeds, config.algorithms)
    }


def table(runs: list[dict[str, Any]]) -> str:
    """Returns a Markdown table with a row for each algorithm."""
    heads = (
        "algorithm", "limit", "cost (95 % over seeds)", "worst seed", "seeds within the limit",
        "success", "lowest", "return", "minutes of training",
    )  # fmt: skip
    rows = []
    for algorithm in dict.fromkeys(run["algorithm"] for run in runs):
        mine = [run for run in runs if run["algorithm"] == algorithm]
        costs, success, limit = episode_costs(mine), each(mine, "success"), mine[0]["cost_limit"]
        rows.append(
            (
                algorithm,
                f"{limit:g}",
                mean_over_seeds(costs),
                f"{worst_seed(costs.unsqueeze(-1)).value.item():.2f}",
                seeds_within(costs, limit),
                f"{fmean(success):.1%}",
                f"{min(success):.1%}",
                f"{fmean(each(mine, 'return')):.2f}",
                f"{fmean(run['seconds'] for run in mine) / 60:.1f}",
            )
        )
    return markdown(heads, rows)


def plot(runs: list[dict[str, Any]], path: Path) -> None:
    """Draws return against cost, a panel for each algorithm: its seeds among all others."""
    names = list(dict.fromkeys(run["algorithm"] for run in runs))
    points = {name: _points(runs, name) for name in names}
    everyone = np.concatenate(list(points.values()))
    limits = {run["algorithm"]: run["cost_limit"] for run in runs}
    widest = max(everyone[:, 0].max(), *limits.values())
    columns = min(len(names), 6)
    rows = -(-len(names) // columns)
    with figure_style():
        figure, grid = plt.subplots(
            rows,
            columns,
            figsize=(2.1 * columns + 0.8, 2.0 * rows + 0.5),
            sharex=True,
            sharey=True,
            squeeze=False,
            layout="constrained",
        )
        cost_axis(grid[0, 0], "x", widest)
        grid[0, 0].set_xlim(-0.02, 1.5 * widest)
        for axis in grid.flat[len(names) :]:
            axis.set_visible(False)
        for axis, name in zip(grid.flat, names, strict=False):
            axis.plot(*everyone[:, :2].T, "o", color=LIGHT, ms=3, zorder=1)
            axis.plot(*points[name][:, :2].T, "o", color=colour(name), ms=7, mec="white", zorder=3)
            limit_line(axis, limits[name], vertical=True)
            success = f"success {points[name][:, 2].mean():.0%}"
            axis.set_title(f"{label(name)}\n{success}", fontsize=9)
            axis.tick_params(axis="x", labelsize=7)
        for axis in grid.flat[max(len(names) - columns, 0) : len(names)]:
            axis.tick_params(axis="x", labelbottom=True)  # Also above an empty place.
        figure.supxlabel("cost of an evaluated episode", fontsize=9)
        figure.supylabel("return", fontsize=9)
        figure.savefig(path)
        plt.close(figure)


def _points(runs: list[dict[str, Any]], algorithm: str) -> np.ndarray:
    """Cost, return and success of each seed of an algorithm."""
    mine = [run for run in runs if run["algorithm"] == algorithm]
    return np.transpose([each(mine, name) for name in ("cost/collision", "return", "success")])


def main(config: Config) -> None:
    """Runs what is missing, then writes table, figure and results.json."""
    grid = jobs(config)
    results = run_grid(train.run, grid, workers=config.jobs, name="compare")
    runs = [
        {
            "algorithm": algorithm,
            "seed": settings.seed,
            "cost_limit": settings.cost_limit,
            **result,
        }
        for (settings, algorithm), result in zip(grid.values(), results, strict=True)
    ]
    save_results(config.out, config, runs, table(runs))
    plot(runs, config.out / "compare.png")


if __name__ == "__main__":
    main(tyro.cli(Config))
