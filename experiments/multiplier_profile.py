"""What a multiplier buys: ``make profile``, return and cost for fixed multipliers.

The Pareto front of return and cost that fixed multipliers trace (as arXiv 2510.17564 recommends to
show), and where the multiplier rules end for some limits: on the front, if they are any good.
Stopped and started again, it goes on with the runs that are missing.
"""

from __future__ import annotations

import dataclasses
import os
from itertools import cycle, product
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import tyro

from experiments import train
from experiments.config import Action, AlgorithmName, Config as TrainConfig, Engine, MultiplierRule
from experiments.grid import run_grid, save_results
from experiments.report import COLOURS

RULES: tuple[MultiplierRule, ...] = ("dual-ascent", "pid")


@dataclasses.dataclass(frozen=True)
class Config:
    """Train with fixed multipliers, and with rules that move them."""

    multipliers: tuple[float, ...] = (0.0, 0.1, 0.3, 1.0, 3.0, 10.0)
    """Fixed multipliers."""
    limits: tuple[float, ...] = (2.0, 0.5)
    """Cost limits that each multiplier rule is given."""
    action: Action = "cartesian"
    """What an action moves."""
    physics: Engine = TrainConfig.physics
    """Engine that simulates the arm."""
    seeds: int = 3
    """Runs of each, with seeds from 0."""
    frames: int = TrainConfig.frames
    """Control steps to train for."""
    eval_episodes: int = 256
    """Episodes of the final evaluation of each run, with the deterministic policy."""
    workers: int = os.cpu_count() or 1
    """Runs side by side."""
    out: Path = Path("runs/profile")
    """Folder of results; runs that are already there are not run again."""


def jobs(config: Config) -> dict[Path, tuple[TrainConfig, AlgorithmName]]:
    """What to run, by the file of its results."""
    return {
        config.out / f"{rule}-{value:g}-{seed}.json": (
            TrainConfig(
                action=config.action,
                physics=config.physics,
                multiplier_rule=rule,
                multiplier_init=value if rule == "fixed" else 0.0,
                cost_limit=0.0 if rule == "fixed" else value,
                seed=seed,
                frames=config.frames,
                eval_episodes=config.eval_episodes,
                workers=1,
                out=config.out / "runs" / f"{rule}-{value:g}-{seed}",
                resume=True,
            ),
            "ppo-lagrangian",
        )
        for seed, (rule, value) in product(range(config.seeds), settings(config))
    }


def settings(config: Config) -> list[tuple[MultiplierRule, float]]:
    """Each rule with the multiplier it keeps, or with the cost limit it is given."""
    fixed: list[tuple[MultiplierRule, float]] = [("fixed", value) for value in config.multipliers]
    return fixed + list(product(RULES, config.limits))


def points(runs: list[dict[str, Any]]) -> dict[tuple[str, float], np.ndarray]:
    """Return, cost, success and last multiplier of each seed, by rule and value."""
    found: dict[tuple[str, float], list[list[float]]] = {}
    for run in runs:
        figures = [run["evaluation"][name][0] for name in ("return", "cost/collision", "success")]
        figures.append(run["history"][-1]["multiplier/collision"])
        found.setdefault((run["rule"], run["value"]), []).append(figures)
    return {key: np.array(rows) for key, rows in found.items()}


def table(runs: list[dict[str, Any]]) -> str:
    """Returns a Markdown table: mean and standard deviation over seeds."""
    lines = ["| | return | cost | success | multiplier at the end |", "|---" * 5 + "|"]
    for (rule, value), rows in points(runs).items():
        name = f"fixed at {value:g}" if rule == "fixed" else f"{rule}, limit {value:g}"
        cells = (f"{m:.2f} ± {s:.2f}" for m, s in zip(rows.mean(0), rows.std(0), strict=True))
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def plot(runs: list[dict[str, Any]], path: Path) -> None:
    """Draws return against cost: each seed, the means of fixed multipliers joined."""
    figure, axis = plt.subplots(figsize=(6.4, 4.4))
    found = points(runs)
    fixed = {value: rows for (rule, value), rows in found.items() if rule == "fixed"}
    middle = np.array([rows.mean(0) for rows in fixed.values()])
    axis.plot(middle[:, 1], middle[:, 0], "o-", color="grey", label="fixed multiplier")
    for value, (reward, cost, *_) in zip(fixed, middle, strict=True):
        axis.annotate(f"{value:g}", (cost, reward), xytext=(5, -12), textcoords="offset points")
        axis.plot(fixed[value][:, 1], fixed[value][:, 0], ".", color="grey", alpha=0.5)
    limits = sorted({value for rule, value in found if rule != "fixed"})
    for rule, colour in zip(RULES, COLOURS[1:], strict=False):
        for limit, marker in zip(limits, cycle("sD^vP*"), strict=False):
            rows = found[rule, limit]
            label = f"{rule}, limit {limit:g}"
            axis.plot(rows[:, 1], rows[:, 0], marker, color=colour, ls="", label=label, alpha=0.7)
    for limit in limits:
        axis.axvline(limit, color="black", ls="--", lw=0.8)
    axis.set(xlabel="evaluated episode cost", ylabel="evaluated return", xscale="symlog")
    axis.grid(alpha=0.3)
    axis.legend(fontsize=8)
    figure.tight_layout()
    figure.savefig(path, dpi=120)
    plt.close(figure)


def main(config: Config) -> None:
    """Runs what is missing, then writes table, figure and results.json."""
    results = run_grid(train.run, jobs(config), workers=config.workers, name="profile")
    names = product(range(config.seeds), settings(config))
    runs = [
        {"rule": rule, "value": value, "seed": seed, **result}
        for (seed, (rule, value)), result in zip(names, results, strict=True)
    ]
    save_results(config.out, config, runs, table(runs))
    plot(runs, config.out / "profile.png")


if __name__ == "__main__":
    main(tyro.cli(Config))
