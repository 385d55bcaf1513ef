"""Draws a contact sheet of every arm, task and layout of obstacles: ``make gallery``."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from pathlib import Path

import matplotlib.pyplot as plt
import tyro
from tqdm import tqdm

from experiments.config import Engine
from experiments.train import PHYSICS
from torchrl_safe.envs import ArmEnv, Camera
from torchrl_safe.envs.gym import ARMS, OBSTACLES, TASKS, combination

# From the side, so that neither the arm nor the human hides the table.
CAMERA = Camera(eye=(0.75, -1.5, 0.9), target=(0.5, 0.0, 0.24), field_of_view=44)


@dataclass(frozen=True)
class Config:
    """Draw a contact sheet of every arm, task and layout of obstacles."""

    arms: tuple[str, ...] = tuple(ARMS)
    """Which arms, by their names in torchrl_safe.envs.gym.ARMS."""
    physics: Engine = "bullet"
    """Engine that simulates and draws them."""
    out: Path = Path("runs/gallery.png")
    """File of the picture."""
    width: int = 200
    """Width of each tile in pixels; its height is three quarters of that."""
    steps: int = 20
    """Control steps before the picture is taken, in which the arm stays where it is."""
    seed: int = 1
    """Seed of goals and obstacles."""


def main(config: Config) -> None:
    """Draws and saves the sheet."""
    rows = list(product(TASKS, OBSTACLES))
    height = config.width * 3 // 4
    figure, grid = plt.subplots(
        len(rows),
        len(config.arms),
        figsize=(len(config.arms) * config.width / 100, len(rows) * height / 100),
        squeeze=False,
        gridspec_kw={"wspace": 0.02, "hspace": 0.02},
    )
    tiles = list(product(enumerate(rows), enumerate(config.arms)))
    for (row, (task, obstacles)), (column, arm) in tqdm(tiles, desc="gallery", unit="tile"):
        axis = grid[row][column]
        parts = combination(arm, task, obstacles, "")
        env = ArmEnv(**parts, physics=PHYSICS[config.physics], seed=config.seed)
        env.rollout(config.steps, lambda td: td.set("action", env.action_spec.zero()))  # noqa: B023
        axis.imshow(env.render(config.width, height, CAMERA)[0].numpy())
        env.close()
        axis.set(xticks=[], yticks=[])
        if row == 0:
            axis.set_title(arm)
        if column == 0:
            axis.set_ylabel(f"{task}\n{obstacles or 'no obstacles'}")
    config.out.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(config.out, dpi=100, bbox_inches="tight")
    plt.close(figure)


if __name__ == "__main__":
    main(tyro.cli(Config))
