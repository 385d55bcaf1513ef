"""Tables and figures of the suite.

Runs are summed up as Agarwal et al. 2021 do, "Deep Reinforcement Learning at the Edge of the
Statistical Precipice" (https://arxiv.org/abs/2108.13264): the interquartile mean over all runs of
all tasks, performance profiles, and the bootstrap stratified by task. Of a run there are two
scores: its success, and the largest of its costs in units of the limits, 1 and less where every
limit is kept.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from experiments.style import colour, figure_style, label, limit_line
from experiments.tables import each, markdown, shown_cost
from torchrl_safe.envs import SUITE
from torchrl_safe.metrics import Estimate, interquartile_mean, mean

Run = Mapping[str, Any]
Limits = Mapping[str, Mapping[str, float]]

_DRAWS = 2000


def draw(runs: Sequence[Run], out: Path) -> str:
    """Draws ``profiles.png`` and ``training.png``, and returns the table."""
    limits = {run["task"]: SUITE[run["task"]].cost_limits for run in runs}
    plot_profiles(runs, limits, out / "profiles.png")
    plot_training(runs, limits, out / "training.png")
    return report(runs, limits)


def report(runs: Sequence[Run], limits: Limits) -> str:
    """Returns Markdown: the suite as a whole, then each task with each cost against its limit."""
    parts = [whole(runs, limits), table(runs, limits)]
    if any("without_shield" in run for run in runs):
        parts.append(shield_table(runs))
    return "\n\n".join(parts) + "\n"


def shield_table(runs: Sequence[Run]) -> str:
    """Returns a Markdown table of what a shield changes: collisions of all training, and after."""
    heads = (
        "task", "algorithm", "seeds", "collisions while training", "success", "return",
        "without its shield: success", "collisions of an episode",
    )  # fmt: skip
    rows = []
    for task, algorithm in _cells(runs):
        mine = _select(runs, task, algorithm)
        if "cost/collision" not in mine[0]["evaluation"]:
            continue
        without = ["", ""]
        if "without_shield" in mine[0]:
            success, cost = (
                _mean_of(mine, "without_shield", name) for name in ("success", "cost/collision")
            )
            without = [f"{success:.1%}", f"{cost:.2f}"]
        rows.append(
            (
                task,
                algorithm,
                str(len(mine)),
                f"{_summed(mine, 'collision'):,.0f}",
                f"{_mean_of(mine, 'evaluation', 'success'):.1%}",
                f"{_mean_of(mine, 'evaluation', 'return'):.2f}",
                *without,
            )
        )
    return markdown(heads, rows)


def table(runs: Sequence[Run], limits: Limits) -> str:
    """Returns a Markdown table with a row for each cost of each task: its mean in each run.

    Costs above their limits are bold. Runs are in the order of their seeds.
    """
    algorithms = _algorithms(runs)
    heads = [
        *(f"cost, {name}" for name in algorithms),
        *(f"success, {name}, %" for name in algorithms),
    ]
    rows = []
    for task in _tasks(runs):
        of_task = [_select(runs, task, algorithm) for algorithm in algorithms]
        success = [", ".join(map(_percent, each(mine, "success"))) for mine in of_task]
        head = f"`{task}`"
        for name, limit in limits[task].items():
            costs = [
                ", ".join(shown_cost(cost, limit) for cost in each(mine, f"cost/{name}"))
                for mine in of_task
            ]
            rows.append((head, name, f"{limit:g}", *costs, *success))
            head, success = "", ["" for _ in algorithms]
    return markdown(("task", "cost", "limit", *heads), rows)


def whole(runs: Sequence[Run], limits: Limits) -> str:
    """Returns a Markdown table with a row for each algorithm, over all tasks."""
    heads = (
        "algorithm", "success (IQM)", "largest cost / limit (IQM)", "runs above a limit",
        "tasks with a cost of three limits or more", "cost while training / PPO's",
    )  # fmt: skip
    rows = []
    algorithms = _algorithms(runs)
    for algorithm in algorithms:
        success, largest = scores(runs, limits, algorithm)
        middle, high = (_interval(interquartile_mean, score) for score in (success, largest))
        above = _interval(mean, (largest > 1).double())
        # The violation of a task is that of its mean over seeds.
        threefold = sum(
            any(
                _mean_of(_select(runs, task, algorithm), "evaluation", f"cost/{name}") >= 3 * limit
                for name, limit in limits[task].items()
            )
            for task in _tasks(runs)
        )
        training = "" if "ppo" not in algorithms else f"{_relative(runs, limits, algorithm):.2f}"
        rows.append(
            (
                algorithm,
                _shown(middle, ".1%"),
                _shown(high, ".2f"),
                _shown(above, ".0%"),
                f"{threefold}/{len(_tasks(runs))}",
                training,
            )
        )
    return (
        f"{markdown(heads, rows)}\n\nIQM: interquartile mean over all runs. Brackets: 95 % "
        "stratified bootstrap. A run is above a limit if the mean of one of its costs is."
    )


def scores(
    runs: Sequence[Run], limits: Limits, algorithm: str
) -> tuple[torch.Tensor, torch.Tensor]:
    """Success and largest cost in units of the limits, each of shape (tasks, seeds)."""
    success, largest = [], []
    for task in _tasks(runs):
        figures = [run["evaluation"] for run in _select(runs, task, algorithm)]
        success.append([figure["success"][0] for figure in figures])
        largest.append([excess(figure, limits[task]) for figure in figures])
    return torch.tensor(success, dtype=torch.float64), torch.tensor(largest, dtype=torch.float64)


def excess(evaluation: Mapping[str, Any], limits: Mapping[str, float]) -> float:
    """The largest cost of an evaluation in units of its limit."""
    return max(evaluation[f"cost/{name}"][0] / limit for name, limit in limits.items())


def profile(
    values: NDArray[np.float64], thresholds: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The share of runs above each threshold, and its band: Agarwal et al. 2021, section 4.2.

    Args:
        values: scores of the runs, (tasks, seeds).
        thresholds: (t,).

    Returns:
        The shares, (t,), and the ends of their pointwise 95 % intervals, (2, t).
    """
    tasks, seeds = values.shape
    drawn = np.random.default_rng(0).integers(seeds, size=(_DRAWS, tasks, seeds))
    again = np.take_along_axis(values[None], drawn, axis=2).reshape(_DRAWS, -1)
    above = np.stack([(again > threshold).mean(1) for threshold in thresholds], axis=1)
    share = (values.reshape(1, -1) > thresholds[:, None]).mean(1)
    return share, np.quantile(above, (0.025, 0.975), axis=0)


def plot_profiles(runs: Sequence[Run], limits: Limits, path: Path) -> None:
    """Draws the performance profiles of success and of the largest cost."""
    with figure_style():
        figure, axes = plt.subplots(1, 2, figsize=(9.6, 3.8))
        of_success, of_cost = np.linspace(0, 1, 101), np.geomspace(0.01, 100, 121)
        for row, algorithm in enumerate(_algorithms(runs)):
            of_runs = scores(runs, limits, algorithm)
            for axis, score, thresholds in zip(axes, of_runs, (of_success, of_cost), strict=True):
                share, band = profile(score.numpy(), thresholds)
                drawn = {"color": colour(algorithm), "step": "post"}
                axis.fill_between(thresholds, *band, alpha=0.2, lw=0, **drawn)
                axis.step(thresholds, share, color=colour(algorithm), where="post")
            # One below the other, where the curves of success are highest.
            axes[0].annotate(
                label(algorithm), (0.03, 0.06 + 0.07 * row), color=colour(algorithm), weight="bold"
            )
        axes[0].set(xlabel="success", ylabel="share of runs with more", ylim=(-0.02, 1.04))
        axes[1].set(xlabel="largest cost / limit", xscale="log", ylim=(-0.02, 1.04))
        limit_line(axes[1], 1, vertical=True, text="")  # The axis says it.
        _save(figure, path)


def plot_training(runs: Sequence[Run], limits: Limits, path: Path) -> None:
    """Draws the costs summed over all frames of training: a panel for each cost of each task."""
    panels = [(task, name) for task in _tasks(runs) for name in limits[task]]
    columns = min(4, len(panels))
    rows = -(-len(panels) // columns)
    with figure_style():
        size = (3.1 * columns, 2.4 * rows)
        figure, grid = plt.subplots(rows, columns, figsize=size, squeeze=False)
        for axis, (task, name) in zip(grid.flat, panels, strict=False):
            for algorithm in _algorithms(runs):
                _plot_sums(axis, _select(runs, task, algorithm), name, algorithm)
            axis.set_title(f"{task}\n{name}", fontsize=8)
            axis.set_ylim(bottom=0)
        for axis in grid.flat[len(panels) :]:
            axis.set_visible(False)
        figure.supxlabel("thousand control steps of training", fontsize=9)
        figure.supylabel("cost so far", fontsize=9)
        _save(figure, path)


def _plot_sums(axis: Axes, runs: Sequence[Run], name: str, algorithm: str) -> None:
    """Mean over seeds and its range, with the algorithm's name at the end."""
    frames = np.array([row["frames"] for row in runs[0]["history"]]) / 1000
    sums = np.array([[row[f"summed/{name}"] for row in run["history"]] for run in runs])
    axis.plot(frames, sums.mean(0), color=colour(algorithm))
    axis.fill_between(frames, sums.min(0), sums.max(0), color=colour(algorithm), alpha=0.2, lw=0)
    axis.annotate(
        label(algorithm),
        (frames[-1], sums.mean(0)[-1]),
        xytext=(-2, 3),
        textcoords="offset points",
        ha="right",
        color=colour(algorithm),
        fontsize=7,
    )


def _save(figure: Figure, path: Path) -> None:
    figure.tight_layout()
    figure.savefig(path)
    plt.close(figure)


def _algorithms(runs: Sequence[Run]) -> list[str]:
    return [*dict.fromkeys(run["algorithm"] for run in runs)]


def _tasks(runs: Sequence[Run]) -> list[str]:
    return [*dict.fromkeys(run["task"] for run in runs)]


def _cells(runs: Sequence[Run]) -> list[tuple[str, str]]:
    return [(task, algorithm) for task in _tasks(runs) for algorithm in _algorithms(runs)]


def _select(runs: Sequence[Run], task: str, algorithm: str) -> list[Run]:
    return [run for run in runs if (run["task"], run["algorithm"]) == (task, algorithm)]


def _mean_of(runs: Sequence[Run], part: str, name: str) -> float:
    return float(np.mean(each(runs, name, part)))


def _percent(share: float) -> str:
    return f"{100 * share:.1f}".removesuffix(".0")


def _summed(runs: Sequence[Run], name: str) -> float:
    """A cost summed over all frames of training, mean over runs."""
    return float(np.mean([run["history"][-1][f"summed/{name}"] for run in runs]))


def _relative(runs: Sequence[Run], limits: Limits, algorithm: str) -> float:
    """Cost of all training in units of PPO's: the mean over the costs of all tasks."""
    shares = [
        _summed(_select(runs, task, algorithm), name)
        / max(_summed(_select(runs, task, "ppo"), name), 1.0)
        for task in _tasks(runs)
        for name in limits[task]
    ]
    return float(np.mean(shares))


def _interval(statistic: Any, values: torch.Tensor) -> Estimate:
    """A statistic over all runs; single seeds leave nothing to draw anew."""
    if values.shape[1] == 1:
        values = values.repeat(1, 2)
    return statistic(values.unsqueeze(-1), resample="episodes")


def _shown(estimate: Estimate, form: str) -> str:
    value, low, high = (format(part.item(), form) for part in estimate)
    return value if low == high == value else f"{value} [{low}, {high}]"
