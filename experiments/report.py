"""Tables and pictures of a training run."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from statistics import fmean
from typing import Any, NamedTuple

import matplotlib.pyplot as plt
import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.ticker import EngFormatter
from PIL import Image
from torchrl.envs import EnvBase

from experiments.config import SHIELDED
from experiments.style import colour, cost_axis, figure_style, label, label_ends, limit_line
from experiments.tables import markdown
from torchrl_safe.metrics import mean

_CURVES = {
    "return": "episode return",
    "cost": "episode cost: ",
    "summed": "cost of all training: ",
}
#: What is drawn while policies learn, and what it cannot leave.
LEARNING = {"return": (-math.inf, math.inf), "cost": (0.0, math.inf), "success": (0.0, 1.0)}
# Batches over which curves are averaged.
_SMOOTH = 5


def table(results: dict[str, Any]) -> str:
    """Returns a Markdown table: a row for each algorithm, estimates with 95 % intervals."""
    rows = {}
    for name, run in results["algorithms"].items():
        rows[name] = run["evaluation"]
        if "without_shield" in run:
            rows[f"{name}, without its shield"] = run["without_shield"]
    return figures_table(rows, results["cost_limits"])


def figures_table(rows: dict[str, dict[str, list[float]]], cost_limits: Mapping[str, float]) -> str:
    """Returns a Markdown table of named rows of figures, each with its interval or without."""
    columns = list(next(iter(rows.values())))
    text = markdown(
        ("evaluation", *map(_heading, columns)),
        [
            (
                name,
                *(_cell(*row[c], share=_is_share(c)) if c in row else "" for c in columns),
            )
            for name, row in rows.items()
        ],
    )
    if len(cost_limits) == 1:
        (limit,) = cost_limits.values()
        shown = f"limit {limit:g}"
    else:
        shown = "limits " + ", ".join(f"{name} {limit:g}" for name, limit in cost_limits.items())
    return f"{text}\n\nCost {shown}; brackets: 95 % confidence."


def episode_costs(runs: list[dict[str, Any]]) -> torch.Tensor:
    """Costs of the evaluated episodes of some runs, shape (seeds, episodes)."""
    costs = torch.tensor([run["episodes"]["episode_cost"] for run in runs])
    return costs.reshape(costs.shape[:2])  # Raises if there are several costs.


def mean_over_seeds(costs: torch.Tensor) -> str:
    """Mean of (seeds, episodes) with its 95 % interval over seeds; of one seed the mean alone."""
    if len(costs) == 1:
        return f"{costs.mean():.2f}"
    middle = mean(costs.unsqueeze(-1), resample="seeds")
    return f"{middle.value.item():.2f} [{middle.low.item():.2f}, {middle.high.item():.2f}]"


def seeds_within(costs: torch.Tensor, limit: float) -> str:
    """How many seeds of (seeds, episodes) keep a limit on average, of how many."""
    return f"{(costs.mean(1) <= limit).sum()}/{len(costs)}"


def plot_curves(results: dict[str, Any], path: Path) -> None:
    """Draws return and cost against frames, and the cost limit: the paper's Figure 2.

    Thin lines are means over the episodes of a batch, thick ones those over five batches. With a
    shield also the costs summed over all of training.
    """
    runs = results["algorithms"]
    history = next(iter(runs.values()))["history"]
    costs = [key for key in max(history, key=len) if key.startswith("cost/")]
    sums = [f"summed/{key.partition('/')[2]}" for key in costs if set(SHIELDED) & set(runs)]
    keys = ["return", *costs, *sums]
    with figure_style():
        figure, grid = plt.subplots(
            1, len(keys), figsize=(4.6 * len(keys), 3.2), squeeze=False, layout="constrained"
        )
        figure.suptitle(
            "Thin: mean of the episodes that end in a batch. Thick: five batches. One seed.",
            fontsize=8,
            x=0.01,
            ha="left",
        )
        for axis, key in zip(grid[0], keys, strict=True):
            ends = []
            for name, run in runs.items():
                points = [(row["frames"], row[key]) for row in run["history"] if key in row]
                if not points:  # No episode has ended.
                    continue
                frames, values = zip(*points, strict=True)
                middle = values if key.startswith("summed/") else running_mean(values)
                axis.plot(frames, values, color=colour(name), lw=0.8, alpha=0.35)
                axis.plot(frames, middle, color=colour(name), lw=1.8)
                ends.append((frames[-1], middle[-1], label(name), colour(name)))
            kind, _, cost = key.partition("/")
            axis.set(xlabel="control steps", title=_CURVES[kind] + cost)
            axis.xaxis.set_major_formatter(EngFormatter(sep=""))
            if kind == "cost":
                limit = results["cost_limits"][cost]
                axis.set_ylim(0, max(axis.get_ylim()[1], 1.15 * limit))
                limit_line(axis, limit)
            elif kind == "summed":
                # From none to thousands.
                cost_axis(axis, "y", max(end[1] for end in ends))
            axis.set_xlim(0, 1.02 * max((end[0] for end in ends), default=1))
            figure.canvas.draw()
            label_ends(axis, ends)
        figure.savefig(path)
        plt.close(figure)


class Line(NamedTuple):
    """Runs of one kind, and how they are drawn."""

    label: str
    colour: str
    #: A figure of each batch of each run; NaN where no episode ended.
    runs: Sequence[Sequence[float]]


def plot_learning(
    rows: Mapping[str, Mapping[str, Sequence[Line]]],
    path: Path,
    *,
    frames_per_point: int,
    width: int,
    limits: Sequence[float],
) -> None:
    """Draws return, cost and success against frames: mean and standard deviation over seeds.

    Args:
        rows: the lines of each panel, by title of the row and name in :data:`LEARNING`.
        path: file to write.
        frames_per_point: control steps of a batch.
        width: batches over which lines are averaged.
        limits: of the cost.
    """
    with figure_style():
        figure, grid = plt.subplots(
            len(rows),
            len(LEARNING),
            figsize=(4 * len(LEARNING), 2.7 * len(rows)),
            sharex=True,
            sharey="col",
            squeeze=False,
            layout="constrained",
        )
        figure.suptitle(
            f"Running means of {width} batches; bands: one standard deviation over seeds; "
            "dashed: limits.",
            fontsize=8,
            x=0.01,
            ha="left",
        )
        ends: dict[Axes, list[tuple[float, float, str, str]]] = {}
        for axes, (title, panels) in zip(grid, rows.items(), strict=True):
            for axis, (name, bounds) in zip(axes, LEARNING.items(), strict=True):
                ends[axis] = []
                for line in panels[name]:
                    curves = np.array([running_mean(run, width) for run in line.runs])
                    frames = frames_per_point * np.arange(1, curves.shape[1] + 1)
                    middle, spread = curves.mean(0), curves.std(0)
                    low, high = (middle - spread).clip(*bounds), (middle + spread).clip(*bounds)
                    axis.plot(frames, middle, color=line.colour)
                    axis.fill_between(frames, low, high, color=line.colour, alpha=0.15, lw=0)
                    ends[axis].append((frames[-1], middle[-1], line.label, line.colour))
                axis.set_title(f"{title}: episode {name}")
                axis.xaxis.set_major_formatter(EngFormatter(sep=""))
                if name == "success":
                    axis.set_ylim(0, 1)
        # All rows share the scales of a column: limits and names come when all lines are there.
        figure.canvas.draw()
        for axes in grid:
            for axis, name in zip(axes, LEARNING, strict=True):
                for limit in limits if name == "cost" else ():
                    # Several would overlap, and their lines have names.
                    text = f"limit {limit:g}" if len(limits) == 1 else ""
                    limit_line(axis, limit, text=text, shade=limit == max(limits))
                label_ends(axis, ends[axis])
        for axis in grid[-1]:
            axis.set_xlabel("control steps")
        figure.savefig(path)
        plt.close(figure)


def running_mean(values: Sequence[float], width: int = _SMOOTH) -> list[float]:
    """Returns the mean of each value and those before it, ``width`` in all at most.

    NaN is left out; the mean of nothing is NaN.

    Examples:
        >>> running_mean([1.0, 3.0, float("nan"), 5.0], width=2)
        [1.0, 2.0, 3.0, 5.0]
    """
    windows = (values[max(0, end - width) : end] for end in range(1, len(values) + 1))
    return [mean_of_known(window) for window in windows]


def mean_of_known(values: Iterable[float]) -> float:
    """Returns the mean of what is not NaN; NaN if there is nothing."""
    known = [value for value in values if not math.isnan(value)]
    return fmean(known) if known else math.nan


def save_picture(env: EnvBase, path: Path) -> None:
    """Saves a picture of the first world at the start of an episode."""
    env.reset()
    Image.fromarray(env.render(width=640, height=480)[0].numpy()).save(path)


def _is_share(column: str) -> bool:
    return column == "success" or column.startswith(("any/", "above/"))


def _heading(column: str) -> str:
    kind, _, name = column.partition("/")
    headings = {
        "cost": f"episode cost: {name}",
        "any": f"episodes with {name}",
        "above": f"episodes above the limit of {name}",
        "worst": f"cost of the worst tenth: {name}",
    }
    return headings.get(kind, kind)


def _cell(estimate: float, *interval: float, share: bool) -> str:
    shown = [f"{value:.1%}" if share else f"{value:.2f}" for value in (estimate, *interval)]
    return f"{shown[0]} [{shown[1]}, {shown[2]}]" if interval else shown[0]
