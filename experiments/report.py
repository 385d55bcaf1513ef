"""Tables and pictures of a training run."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import torch
from PIL import Image
from torchrl.envs import EnvBase

from torchrl_safe.metrics import mean

_CURVES = {
    "return": "episode return",
    "cost": "episode cost: ",
    "summed": "cost of all training: ",
}
COLOURS = ("tab:orange", "tab:blue", "tab:green", "tab:purple")


def table(results: dict[str, Any]) -> str:
    """Returns a Markdown table: a row for each algorithm, estimates with 95 % intervals."""
    rows = {name: run["evaluation"] for name, run in results["algorithms"].items()}
    return figures_table(rows, results["cost_limits"])


def figures_table(rows: dict[str, dict[str, list[float]]], cost_limits: Mapping[str, float]) -> str:
    """Returns a Markdown table of named rows of figures, each with its interval or without."""
    columns = list(next(iter(rows.values())))
    lines = [
        "| evaluation | " + " | ".join(_heading(column) for column in columns) + " |",
        "|---" * (len(columns) + 1) + "|",
    ]
    for name, row in rows.items():
        cells = (_cell(*row[column], share=_is_share(column)) for column in columns)
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    if len(cost_limits) == 1:
        (limit,) = cost_limits.values()
        shown = f"limit {limit:g}"
    else:
        shown = "limits " + ", ".join(f"{name} {limit:g}" for name, limit in cost_limits.items())
    lines.append(f"\nCost {shown}; brackets: 95 % confidence.")
    return "\n".join(lines)


def episode_costs(runs: list[dict[str, Any]]) -> torch.Tensor:
    """Costs of the evaluated episodes of some runs, shape (seeds, episodes)."""
    return torch.tensor([run["episodes"]["episode_cost"] for run in runs]).squeeze(-1)


def successes(runs: list[dict[str, Any]]) -> list[float]:
    """Share of the evaluated episodes that reach the target, for each run."""
    return [run["evaluation"]["success"][0] for run in runs]


def mean_over_seeds(costs: torch.Tensor) -> str:
    """Mean of (seeds, episodes) with its 95 % interval over seeds; of one seed, over episodes."""
    middle = mean(costs.unsqueeze(-1), resample="seeds" if len(costs) > 1 else "episodes")
    return f"{middle.value.item():.2f} [{middle.low.item():.2f}, {middle.high.item():.2f}]"


def seeds_within(costs: torch.Tensor, limit: float) -> str:
    """How many seeds of (seeds, episodes) keep a limit on average, of how many."""
    return f"{(costs.mean(1) <= limit).sum()}/{len(costs)}"


def plot_curves(results: dict[str, Any], path: Path) -> None:
    """Draws return and cost against frames, and the cost limit: the paper's Figure 2.

    With a shield also the costs summed over all of training.
    """
    runs = results["algorithms"]
    history = next(iter(runs.values()))["history"]
    costs = [key for key in max(history, key=len) if key.startswith("cost/")]
    sums = [f"summed/{key.partition('/')[2]}" for key in costs if "ppo-shield" in runs]
    keys = ["return", *costs, *sums]
    figure, grid = plt.subplots(1, len(keys), figsize=(5 * len(keys), 3.6), squeeze=False)
    axes = list(grid[0])
    for axis, key in zip(axes, keys, strict=True):
        for index, (name, run) in enumerate(runs.items()):
            colour = COLOURS[index] if index < len(COLOURS) else plt.get_cmap("tab20")(index)
            rows = [row for row in run["history"] if key in row]
            axis.plot([r["frames"] for r in rows], [r[key] for r in rows], color=colour, label=name)
        kind, _, cost = key.partition("/")
        axis.set(xlabel="frames", ylabel=_CURVES[kind] + cost)
        axis.grid(alpha=0.3)
    for axis, limit in zip(axes[1:], results["cost_limits"].values(), strict=False):
        axis.axhline(limit, color="black", ls="--", label="limit")
    for axis in axes[1 + len(costs) :]:
        # From none to thousands.
        axis.set_yscale("symlog", linthresh=10)
    axes[len(costs)].legend()
    figure.tight_layout()
    figure.savefig(path, dpi=120)
    plt.close(figure)


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
