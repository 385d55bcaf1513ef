"""Films the policies of a run of ``make train`` side by side, as at the top of README.

``python -m experiments.film_run --run runs/x --out docs/figures/hero.webp``
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import torch
import tyro

from experiments import train
from experiments.config import AlgorithmName, Config as TrainConfig
from experiments.film import check_film
from torchrl_safe._checks import check_count


@dataclass(frozen=True)
class Config:
    """Film the policies of a run side by side."""

    run: Path
    """Folder of the run."""
    out: Path
    """File to write, .gif or .webp."""
    algorithms: tuple[AlgorithmName, ...] = ("ppo", "ppo-lagrangian")
    """Whose policies."""
    episodes: int = 3
    """Episodes to film."""
    seed: int = 0
    """Seed of the episodes."""
    width: int = 400
    """Width of each picture in pixels."""

    def __post_init__(self) -> None:
        check_film("out", self.out)
        check_count(episodes=self.episodes, width=self.width)


def main(config: Config) -> None:
    """Films, with shadows and smooth edges."""
    torch.set_num_threads(1)
    settings = json.loads((config.run / "results.json").read_text())["config"]
    train.film(
        TrainConfig(
            **{**settings, "algorithms": config.algorithms, "shield": False, "out": config.run}
        ),
        config.out,
        seed=config.seed,
        episodes=config.episodes,
        width=config.width,
        fine=True,
    )


if __name__ == "__main__":
    main(tyro.cli(Config))
