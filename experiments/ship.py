"""Chooses the best policy of each task of a suite, and writes it and its card into the package.

``python -m experiments.ship --suite runs/suite``
"""

from __future__ import annotations

import dataclasses
import io
import json
from pathlib import Path
from typing import Any

import torch
import tyro

import torchrl_safe
from experiments import evaluate, suite
from experiments.config import SET_BY_SUITE, AlgorithmName
from experiments.files import write_whole
from experiments.log import versions
from experiments.suite_report import excess
from experiments.train import CHANGEABLE
from torchrl_safe._files import writing
from torchrl_safe.envs import SUITE
from torchrl_safe.policy import load_policy


@dataclasses.dataclass(frozen=True)
class Config:
    """Ship the best policies of a suite."""

    suite: Path = Path("runs/suite")
    """Folder of the suite."""
    algorithm: AlgorithmName = "ppo-lagrangian"
    """Whose policies."""
    episodes: int = 4096
    """Episodes of the card; the choice was made on others. Many, because most of a pushing policy's
    cost comes from the rare episodes in which the arm gets stuck."""
    seed: int = 3_000_000
    """Seed of these episodes."""
    out: Path = Path(torchrl_safe.__file__).parent / "policies"
    """Folder of policies and cards."""


def best(runs: list[dict[str, Any]], limits: dict[str, float]) -> dict[str, Any] | None:
    """The run furthest below its limits, of those that succeed nearly as often as the best.

    Far below a limit there is room for another engine or another arm of the same make.
    """

    def success(run: dict[str, Any]) -> float:
        return run["evaluation"]["success"][0]

    def largest(run: dict[str, Any]) -> float:
        return excess(run["evaluation"], limits)

    kept = [run for run in runs if largest(run) <= 1]
    often = 0.99 * max(map(success, kept), default=0.0)
    return min((run for run in kept if success(run) >= often), key=largest, default=None)


def contents(file: Path) -> dict[str, Any]:
    """What a policy's file holds, without where it was made and options that had no effect."""
    found = torch.load(file, map_location="cpu", weights_only=True)
    unneeded = (*CHANGEABLE, *SET_BY_SUITE, "workers")
    settings = found["settings"].items()
    found["settings"] = {name: value for name, value in settings if name not in unneeded}
    return found


def card(config: Config, file: Path) -> dict[str, Any]:
    """What a policy is for, and how good it is in episodes that nothing has used before."""
    saved = load_policy(file)
    settings = saved.settings
    asked = evaluate.Config(file, episodes=config.episodes, seed=config.seed)
    limits = evaluate.cost_limits(asked, saved)
    env = evaluate.factory(asked, saved)(num_envs=32)
    try:
        figures = evaluate.play(env, saved, asked, limits)
    finally:
        env.close()
    task = settings["suite_task"]
    return {
        "task": task,
        "cost_limits": dict(SUITE[task].cost_limits),
        "physics": settings["physics"],
        "episodes": config.episodes,
        "seed": config.seed,
        **{name: [round(part, 4) for part in figure] for name, figure in figures.items()},
        "trained": f'make suite ARGS="--tasks {task} --algorithms {settings["name"]} '
        f"--seeds {settings['seed']} --physics {settings['physics']} "
        f'--frames {settings["frames"]}"',
        "frames": settings["frames"],
        "versions": versions(),
    }


def main(config: Config) -> None:
    """Writes the policies and cards of all tasks that have a run within the limits."""
    runs = json.loads((config.suite / "results.json").read_text())["runs"]
    config.out.mkdir(parents=True, exist_ok=True)
    for task in dict.fromkeys(run["task"] for run in runs):
        mine = [r for r in runs if (r["task"], r["algorithm"]) == (task, config.algorithm)]
        chosen = best(mine, dict(SUITE[task].cost_limits))
        if chosen is None:
            print(f"{task}: no run keeps every limit")
            continue
        file = suite.folder(config.suite, task, chosen["seed"]) / config.algorithm / "policy.pt"
        buffer = io.BytesIO()
        torch.save(contents(file), buffer)
        with writing(config.out / f"{task}.pt") as shipped:
            shipped.write(buffer.getbuffer())
        text = json.dumps(card(config, config.out / f"{task}.pt"), indent=1)
        write_whole(config.out / f"{task}.json", text + "\n")
        print(f"{task}: seed {chosen['seed']}, {len(buffer.getbuffer()) / 1000:.0f} kB")


if __name__ == "__main__":
    main(tyro.cli(Config))
