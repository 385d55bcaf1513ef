"""Our PPO-Lagrangian with its defaults against OmniSafe's with its own: ``make safe-gym-grid``.

Same environments, limit and steps, several seeds. To resume it, repeat the command: it runs what is
missing. Needs OmniSafe, which ``make safe-gym-grid`` installs.
"""

from __future__ import annotations

import dataclasses
import shutil
from collections.abc import Mapping
from itertools import product
from pathlib import Path
from time import perf_counter, process_time
from typing import Any, Literal

import torch
import tyro

from experiments import safe_gym
from experiments.grid import check_grid, run_grid, save_results
from experiments.tables import markdown
from torchrl_safe._cores import cores

Library = Literal["ours", "omnisafe"]


@dataclasses.dataclass(frozen=True)
class Config:
    """Compare with OmniSafe's PPOLag."""

    envs: tuple[str, ...] = ("SafetySwimmerVelocity-v1", "SafetyHopperVelocity-v1")
    """Environments of Safety-Gymnasium."""
    libraries: tuple[Library, ...] = ("ours", "omnisafe")
    """Whose PPO-Lagrangian to train with."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Seeds of the runs."""
    frames: int = 500_000
    """Steps to train for; whole epochs of OmniSafe, 20,000 steps each. Ours are rounded up to whole
    batches."""
    cost_limit: float = 25.0
    """Limit of the expected cost of an episode."""
    jobs: int = cores()
    """Runs side by side."""
    out: Path = Path("runs/safe-gym")
    """Folder of results; runs that are already there are not run again."""

    def __post_init__(self) -> None:
        check_grid(self, "envs", "libraries", "seeds")


@dataclasses.dataclass(frozen=True)
class Run:
    """One run of the grid."""

    library: Library
    env: str
    seed: int
    frames: int
    cost_limit: float
    out: Path


def run(job: Run) -> dict[str, Any]:
    """Trains once. Returns curves of return and cost by steps, and the seconds that it took."""
    torch.set_num_threads(1)
    shutil.rmtree(job.out, ignore_errors=True)  # Of a run that was stopped.
    wall, cpu = perf_counter(), process_time()
    history = train_ours(job) if job.library == "ours" else train_omnisafe(job)
    seconds = {"seconds": perf_counter() - wall, "cpu_seconds": process_time() - cpu}
    last = [row for row in history if row["frames"] > 0.9 * job.frames]
    final = {name: sum(row[name] for row in last) / len(last) for name in ("return", "cost")}
    about = {"library": job.library, "env": job.env, "seed": job.seed}
    return {**about, **seconds, **final, "history": history}


def train_ours(job: Run) -> list[dict[str, float]]:
    """Trains with the defaults of ``python -m experiments.safe_gym``."""
    config = safe_gym.Config(
        env=job.env,
        cost_limit=(job.cost_limit,),
        frames=job.frames,
        seed=job.seed,
        out=job.out,
    )
    _, log = safe_gym.train(config, progress=False)
    return [
        {"frames": row["frames"], "return": row["return"], "cost": row["cost/cost"]}
        for row in log.rows
        if "return" in row
    ]


def train_omnisafe(job: Run) -> list[dict[str, float]]:
    """Trains with OmniSafe's defaults, on one thread as ours."""
    import omnisafe

    agent = omnisafe.Agent(
        "PPOLag",
        job.env,
        custom_cfgs={
            "seed": job.seed,
            "train_cfgs": {"total_steps": job.frames, "torch_threads": 1, "device": "cpu"},
            "lagrange_cfgs": {"cost_limit": job.cost_limit},
            "logger_cfgs": {
                "use_wandb": False,
                "use_tensorboard": False,
                "log_dir": str(job.out),
            },
        },
    )
    # What its files hold is a mean over the last 100 episodes: these are the episodes themselves.
    episodes: list[dict[str, float]] = []
    store = agent.agent.logger.store

    def remember(data: Mapping[str, Any] | None = None, /, **kwargs: Any) -> None:
        if data and "Metrics/EpRet" in data:
            before, steps = episodes[-1]["frames"] if episodes else 0, float(data["Metrics/EpLen"])
            episodes.append(
                {
                    "frames": before + steps,
                    "return": float(data["Metrics/EpRet"]),
                    "cost": float(data["Metrics/EpCost"]),
                    "steps": steps,
                }
            )
        store(data, **kwargs)

    agent.agent.logger.store = remember
    agent.learn()
    return episodes


def jobs(config: Config) -> dict[Path, tuple[Run]]:
    """What to run, by the file of its results."""
    found = {}
    for seed, env, library in product(config.seeds, config.envs, config.libraries):
        folder = config.out / library / env / str(seed)
        found[folder.with_suffix(".json")] = (
            Run(library, env, seed, config.frames, config.cost_limit, folder),
        )
    return found


def table(runs: list[dict[str, Any]], config: Config) -> str:
    """Returns a Markdown table with a row for each environment and library."""
    rows = []
    for env, library in product(config.envs, config.libraries):
        mine = [run for run in runs if (run["env"], run["library"]) == (env, library)]
        returns, costs = (", ".join(f"{run[k]:.1f}" for run in mine) for k in ("return", "cost"))
        # One thread each: what a run takes on a core of its own.
        minutes = sum(run["cpu_seconds"] for run in mine) / len(mine) / 60
        rows.append((env, library, returns, costs, f"{minutes:.1f}"))
    cost = f"cost (limit {config.cost_limit:g})"
    text = markdown(("environment", "PPO-Lagrangian", "return", cost, "CPU minutes"), rows)
    return f"{text}\n\nSeeds side by side, means of the last tenth of training."


def main(config: Config) -> None:
    """Runs what is missing, then writes table and results.json."""
    runs = run_grid(run, jobs(config), workers=config.jobs, name="safe-gym")
    save_results(config.out, config, runs, table(runs, config))


if __name__ == "__main__":
    main(tyro.cli(Config))
