"""Is the limit kept, whatever it is? ``make sweep``: final cost against cost limit.

Trains PPO-Lagrangian as ``make train`` does, with its defaults, for each limit, action and seed,
and PPO for comparison. To resume it, repeat the command: it runs what is missing.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable
from itertools import product
from pathlib import Path
from statistics import fmean
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import tyro
from matplotlib.colors import to_hex

from experiments import train
from experiments.config import Action, AlgorithmName, Config as TrainConfig, Engine, Observation
from experiments.grid import check_grid, run_grid, save_results
from experiments.report import (
    Line,
    episode_costs,
    mean_over_seeds,
    plot_learning,
    seeds_within,
)
from experiments.style import ALARM, INK, colour, cost_axis, figure_style, label, label_ends
from experiments.tables import each, markdown
from torchrl_safe._cores import cores
from torchrl_safe.metrics import mean, worst_seed


@dataclasses.dataclass(frozen=True)
class Config:
    """Train for several cost limits and see whether they are kept."""

    paper: bool = False
    """Train in the paper's environment instead of the benchmark."""
    limits: tuple[float, ...] = (10.0, 5.0, 2.0, 1.0, 0.5)
    """Limits of the expected cost of an episode."""
    limit_share: float = TrainConfig.limit_share
    """Share of each limit that training aims at."""
    actions: tuple[Action, ...] = ("cartesian", "joint")
    """What an action moves."""
    observation: Observation = "full"
    """What the policy sees."""
    physics: Engine | None = None
    """Engine that simulates the arm: by default mujoco, and bullet with the paper's environment."""
    seeds: tuple[int, ...] = (0, 1, 2, 3, 4)
    """Seeds of the runs."""
    frames: int = TrainConfig.frames
    """Control steps to train for."""
    frames_per_batch: int = TrainConfig.frames_per_batch
    """Control steps between two updates of policy and multiplier."""
    episode_steps: int | None = TrainConfig.episode_steps
    """Control steps after which an episode to learn from is cut off."""
    first_log_std: float = TrainConfig.first_log_std
    """Logarithm of the policy's standard deviation at the start."""
    eval_episodes: int = 256
    """Episodes of the final evaluation of each run, with the deterministic policy."""
    jobs: int = cores()
    """Runs side by side."""
    out: Path = Path("runs/sweep")
    """Folder of results; runs that are already there are not run again."""

    def __post_init__(self) -> None:
        check_grid(self, "actions", "limits", "seeds")
        if min(self.limits) <= 0:
            raise ValueError(f"limits must be positive, got {self.limits}.")


def jobs(config: Config) -> dict[Path, tuple[TrainConfig, AlgorithmName]]:
    """What to run, by the file of its results."""
    return {
        config.out / f"{_name(action, limit, seed)}.json": (
            TrainConfig(
                paper=config.paper,
                action=action,
                observation=config.observation,
                physics=config.physics or ("bullet" if config.paper else "mujoco"),
                cost_limit=limit or 0.0,
                limit_share=config.limit_share,
                seed=seed,
                frames=config.frames,
                frames_per_batch=config.frames_per_batch,
                episode_steps=config.episode_steps,
                first_log_std=config.first_log_std,
                eval_episodes=config.eval_episodes,
                workers=1,
                out=config.out / "runs" / _name(action, limit, seed),
                resume=True,
            ),
            "ppo" if limit is None else "ppo-lagrangian",
        )
        for seed, action, limit in names(config)
    }


def names(config: Config) -> Iterable[tuple[int, Action, float | None]]:
    """Seed, action and limit of each run; no limit stands for PPO."""
    return product(config.seeds, config.actions, (*config.limits, None))


def table(runs: list[dict[str, Any]], config: Config) -> str:
    """Returns a Markdown table with a row for each action and limit."""
    heads = (
        "action", "limit", "seeds within", "worst seed", "cost (95 % over seeds)", "success",
        "lowest", "return", "multiplier",
    )  # fmt: skip
    rows = []
    for action, limit in product(config.actions, (*config.limits, None)):
        mine = _select(runs, action, limit)
        costs = episode_costs(mine)
        multipliers = [run["history"][-1]["multiplier/collision"] for run in mine]
        success = each(mine, "success")
        rows.append(
            (
                action,
                "none (PPO)" if limit is None else f"{limit:g}",
                "" if limit is None else seeds_within(costs, limit),
                f"{worst_seed(costs.unsqueeze(-1)).value.item():.2f}",
                mean_over_seeds(costs),
                f"{fmean(success):.1%}",
                f"{min(success):.1%}",
                f"{fmean(each(mine, 'return')):.2f}",
                f"{min(multipliers):.2f} to {max(multipliers):.2f}",
            )
        )
    return markdown(heads, rows)


def plot(runs: list[dict[str, Any]], config: Config, path: Path) -> None:
    """Draws the cost of each seed, with its 95 % interval, against the limit."""
    columns, hue = len(config.actions), colour("ppo-lagrangian")
    least, most = min(config.limits) / 1.5, max(config.limits) * 1.5
    highest = max(run["evaluation"]["cost/collision"][2] for run in runs)
    with figure_style():
        figure, axes = plt.subplots(
            1,
            columns,
            figsize=(4.6 * columns, 3.6),
            squeeze=False,
            sharey=True,
            layout="constrained",
        )
        for axis, action in zip(axes[0], config.actions, strict=True):
            axis.set_xscale("log")
            cost_axis(axis, "y", max(most, highest))
            axis.set(xlim=(least, most), ylim=(-0.02, 1.3 * max(most, highest)))
            axis.set_xticks(config.limits, [f"{limit:g}" for limit in config.limits])
            axis.minorticks_off()
            # A straight line would not be one on these axes.
            limits = np.geomspace(least, most, 50)
            axis.plot(limits, limits, color=INK, lw=1, ls=(0, (4, 3)))
            axis.fill_between(limits, limits, axis.get_ylim()[1], color=ALARM, alpha=0.05, lw=0)
            axis.annotate(
                "above the limit",
                (least, axis.get_ylim()[1]),
                xytext=(4, -4),
                va="top",
                textcoords="offset points",
                color=ALARM,
                fontsize=8,
            )
            for (place, seed), limit in product(enumerate(config.seeds), config.limits):
                (mine,) = (r for r in _select(runs, action, limit) if r["seed"] == seed)
                value, low, high = mine["evaluation"]["cost/collision"]
                # Beside each other, not on top of each other.
                x = limit * 1.06 ** (place - (len(config.seeds) - 1) / 2)
                axis.plot([x, x], [low, high], color=hue, alpha=0.5)
                axis.plot(x, value, "o", color=hue, ms=4)
            costs = episode_costs(_select(runs, action, None)).unsqueeze(-1)
            ppo = mean(costs, resample="seeds" if len(costs) > 1 else "episodes")
            axis.axhline(ppo.value.item(), color=colour("ppo"), lw=1.5)
            axis.axhspan(ppo.low.item(), ppo.high.item(), color=colour("ppo"), alpha=0.15, lw=0)
            axis.set(title=f"{action.capitalize()} actions", xlabel="cost limit")
            figure.canvas.draw()
            nearest = _select(runs, action, max(config.limits))
            middle = fmean(each(nearest, "cost/collision"))
            label_ends(
                axis,
                [
                    (most, ppo.value.item(), label("ppo"), colour("ppo")),
                    (most, middle, label("ppo-lagrangian"), hue),
                    (most, most, "limit", INK),
                ],
            )
        axes[0, 0].set_ylabel("cost of an evaluated episode")
        figure.savefig(path)
        plt.close(figure)


def plot_curves(runs: list[dict[str, Any]], config: Config, path: Path) -> None:
    """Draws how PPO and each limit learn; the smaller a limit, the darker its line."""
    keys = {"return": "return", "cost": "cost/collision", "success": "success"}
    blues = plt.get_cmap("Blues")(np.linspace(0.95, 0.45, len(config.limits)))
    hues = dict(zip(sorted(config.limits), map(to_hex, blues), strict=True))

    def lines(action: Action, key: str) -> list[Line]:
        return [
            Line(
                label("ppo") if limit is None else f"limit {limit:g}",
                colour("ppo") if limit is None else hues[limit],
                [
                    [row.get(key, math.nan) for row in run["history"]]
                    for run in _select(runs, action, limit)
                ],
            )
            for limit in (*config.limits, None)
        ]

    rows = {
        f"{action.capitalize()} actions": {name: lines(action, key) for name, key in keys.items()}
        for action in config.actions
    }
    first, *_ = runs
    frames = first["history"][0]["frames"]
    plot_learning(rows, path, frames_per_point=frames, width=10, limits=config.limits)


def main(config: Config) -> None:
    """Runs what is missing, then writes table, figures and results.json."""
    results = run_grid(train.run, jobs(config), workers=config.jobs, name="sweep")
    runs = [
        {"action": action, "limit": limit, "seed": seed, **result}
        for (seed, action, limit), result in zip(names(config), results, strict=True)
    ]
    save_results(config.out, config, runs, table(runs, config))
    plot(runs, config, config.out / "sweep.png")
    plot_curves(runs, config, config.out / "curves.png")


def _name(action: Action, limit: float | None, seed: int) -> str:
    return f"{action}-{'none' if limit is None else f'{limit:g}'}-{seed}"


def _select(
    runs: list[dict[str, Any]], action: Action, limit: float | None
) -> list[dict[str, Any]]:
    return [run for run in runs if run["action"] == action and run["limit"] == limit]


if __name__ == "__main__":
    main(tyro.cli(Config))
