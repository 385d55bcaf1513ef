"""What a multiplier buys: ``make profile``, return and cost for fixed multipliers.

The Pareto front of return and cost that fixed multipliers trace (as arXiv 2510.17564 recommends to
show), and where the multiplier rules end for some limits. Good rules end on the front. To resume
it, repeat the command: it runs what is missing.
"""

from __future__ import annotations

import dataclasses
from itertools import cycle, product
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import tyro
from matplotlib.axes import Axes

from experiments import train
from experiments.config import Action, AlgorithmName, Config as TrainConfig, Engine, MultiplierRule
from experiments.grid import check_grid, run_grid, save_results
from experiments.style import GREY, colour, cost_axis, figure_style, limit_line
from experiments.tables import markdown
from torchrl_safe._cores import cores

RULES: dict[MultiplierRule, str] = {"dual-ascent": "DualAscent", "pid": "PIDControl"}


@dataclasses.dataclass(frozen=True)
class Config:
    """Train with fixed multipliers, and with rules that move them."""

    multipliers: tuple[float, ...] = (0.0, 0.1, 0.3, 1.0, 3.0, 10.0)
    """Fixed multipliers."""
    limits: tuple[float, ...] = (2.0, 0.5)
    """Cost limits that each multiplier rule is given."""
    action: Action = "cartesian"
    """What an action moves."""
    physics: Engine = "mujoco"
    """Engine that simulates the arm; bullet takes several times as long."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Seeds of the runs."""
    frames: int = TrainConfig.frames
    """Control steps to train for."""
    eval_episodes: int = 256
    """Episodes of the final evaluation of each run, with the deterministic policy."""
    jobs: int = cores()
    """Runs side by side."""
    out: Path = Path("runs/profile")
    """Folder of results; runs that are already there are not run again."""

    def __post_init__(self) -> None:
        check_grid(self, "multipliers", "limits", "seeds")


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
                limit_share=1.0,  # What a limit gives, not what a margin does.
                seed=seed,
                frames=config.frames,
                eval_episodes=config.eval_episodes,
                workers=1,
                out=config.out / "runs" / f"{rule}-{value:g}-{seed}",
                resume=True,
            ),
            "ppo-lagrangian",
        )
        for seed, (rule, value) in product(config.seeds, settings(config))
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
    rows = []
    for (rule, value), seeds in points(runs).items():
        name = f"fixed at {value:g}" if rule == "fixed" else f"{rule}, limit {value:g}"
        cells = (f"{m:.2f} ± {s:.2f}" for m, s in zip(seeds.mean(0), seeds.std(0), strict=True))
        rows.append((name, *cells))
    return markdown(("", "return", "cost", "success", "multiplier at the end"), rows)


def plot(runs: list[dict[str, Any]], path: Path) -> None:
    """Draws return against cost, a panel for each rule: where it ends on the fixed ones' front."""
    found = points(runs)
    fixed = {value: rows for (rule, value), rows in found.items() if rule == "fixed"}
    limits = sorted({value for rule, value in found if rule != "fixed"})
    most = max(rows[:, 1].max() for rows in found.values())
    with figure_style():
        figure, grid = plt.subplots(
            1,
            len(RULES),
            figsize=(4.6 * len(RULES), 3.6),
            sharex=True,
            sharey=True,
            squeeze=False,
            layout="constrained",
        )
        cost_axis(grid[0, 0], "x", most)
        grid[0, 0].set(xlim=(-0.03, 1.7 * most), ylabel="return")
        grid[0, 0].margins(y=0.12)  # Room for names.
        for axis, (rule, title) in zip(grid[0], RULES.items(), strict=True):
            _draw_front(axis, fixed)
            axis.set(xlabel="cost of an evaluated episode", title=title)
            for limit in limits:
                limit_line(axis, limit, vertical=True, text=f"limit {limit:g}", shade=False)
            for limit, marker in zip(limits, cycle("osD^v"), strict=False):
                rows = found[rule, limit]
                axis.plot(
                    rows[:, 1], rows[:, 0], marker, ms=6, color=colour("ppo-lagrangian"), alpha=0.8
                )
                axis.annotate(
                    f"told to keep {limit:g}",
                    (rows[:, 1].min(), rows[:, 0].max()),
                    xytext=(-8, 3),
                    textcoords="offset points",
                    ha="right",
                    color=colour("ppo-lagrangian"),
                    fontweight="bold",
                    fontsize=8,
                )
        figure.savefig(path)
        plt.close(figure)


def _draw_front(axis: Axes, fixed: dict[float, np.ndarray]) -> None:
    """Every seed of the fixed multipliers; a line joins their medians, whose ends have names."""
    middle = np.array([np.median(rows, axis=0) for rows in fixed.values()])
    axis.plot(middle[:, 1], middle[:, 0], "-", color=GREY, lw=1, zorder=1)
    for rows in fixed.values():
        axis.plot(rows[:, 1], rows[:, 0], "o", color=GREY, ms=4, zorder=2)
    for (reward, cost, *_), value in zip(middle, fixed, strict=True):
        if value in (min(fixed), max(fixed)):
            axis.annotate(
                f"fixed at {value:g}",
                (cost, reward),
                xytext=(7, -3),
                textcoords="offset points",
                color=GREY,
                fontsize=8,
            )


def main(config: Config) -> None:
    """Runs what is missing, then writes table, figure and results.json."""
    results = run_grid(train.run, jobs(config), workers=config.jobs, name="profile")
    names = product(config.seeds, settings(config))
    runs = [
        {"rule": rule, "value": value, "seed": seed, **result}
        for (seed, (rule, value)), result in zip(names, results, strict=True)
    ]
    save_results(config.out, config, runs, table(runs))
    plot(runs, config.out / "profile.png")


if __name__ == "__main__":
    main(tyro.cli(Config))
