"""Eager time of a minibatch for each loss, in this checkout and in another, in turn.

``python -m benchmarks.losses --against ../other`` prints for each loss its milliseconds and the
ratio of this checkout's time to the other's: the median over turns, taken in pairs. A process keeps
the memory it was given, which alone can make a loss 5 % slower, so each round starts new ones, and
the ratio is the median of the rounds, with the lowest and the highest beside it.
"""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from time import process_time

import torch
import tyro
from torchrl.objectives import A2CLoss, ClipPPOLoss, LossModule, SACLoss, TD3Loss

import torchrl_safe.objectives as ours
from benchmarks.networks import (
    make_actor,
    make_critic,
    make_deterministic_actor,
    make_minibatch,
    make_q_critic,
    make_transitions,
)


@dataclass(frozen=True)
class Config:
    """Compare this checkout's losses with another's."""

    against: Path = Path()
    """Root of the other checkout."""
    sizes: tuple[int, ...] = (64, 256)
    """Steps in a minibatch."""
    rounds: int = 9
    """How often new processes are started."""
    turns: int = 60
    """How often each loss is timed in a round, in both checkouts."""
    calls: int = 1
    """Forward and backward passes in a turn."""
    worker: bool = False
    """Serve times to another process, one for each line that comes in."""


def make_losses() -> dict[str, LossModule]:
    """Every loss, with one cost."""
    losses = {}
    for name in ("PPOLagrangian", "FOCOPS", "CUP", "P3O", "IPO", "TrustRegion"):
        networks = make_actor(), make_critic("state_value"), make_critic("cost_value")
        losses[name] = getattr(ours, f"{name}Loss")(*networks)
    for name, parent in (
        ("Lagrangian", ClipPPOLoss),
        ("Lagrangian", A2CLoss),
        ("CRPO", ClipPPOLoss),
    ):
        wrapped = parent(make_actor(), make_critic("state_value"))
        title = f"{name}({parent.__name__})"
        losses[title] = getattr(ours, f"{name}Loss")(wrapped, make_critic("cost_value"))
    critics = make_q_critic("state_action_value"), make_q_critic("state_action_cost_value")
    losses["SACLagrangian"] = ours.SACLagrangianLoss(make_actor(), *critics, target_entropy=-7.0)
    losses["TD3Lagrangian"] = ours.TD3LagrangianLoss(
        make_deterministic_actor(), *critics, bounds=(-1.0, 1.0)
    )
    return losses


def serve(config: Config) -> None:
    """Reads ``name size`` and answers with seconds, until the input ends."""
    torch.set_num_threads(1)
    losses = make_losses()
    batches, transitions = {}, {}
    for size in config.sizes:
        batches[size] = make_minibatch(size)
        dist = torch.randn(size, 7), torch.ones(size, 7)
        batches[size]["loc"], batches[size]["scale"] = dist
        transitions[size] = make_transitions(size)
    for line in sys.stdin:
        name, steps = line.split()
        loss = losses[name]
        off_policy = isinstance(loss, SACLoss | TD3Loss)
        batch = (transitions if off_policy else batches)[int(steps)]
        start = process_time()
        for _ in range(config.calls):
            outputs = loss(batch)
            sum(value for key, value in outputs.items() if key.startswith("loss_")).backward()
        print((process_time() - start) / config.calls, flush=True)


def start_worker(root: Path, folder: Path, config: Config) -> subprocess.Popen[str]:
    """A process with the losses of a checkout, and with this file's benchmarks."""
    folder.mkdir()
    (folder / "torchrl_safe").symlink_to(root.resolve() / "torchrl_safe")
    (folder / "benchmarks").symlink_to(Path(__file__).resolve().parent)
    command = [sys.executable, "-m", "benchmarks.losses", "--worker", "--calls", str(config.calls)]
    return subprocess.Popen(
        [*command, "--sizes", *map(str, config.sizes)],
        env={**os.environ, "PYTHONPATH": str(folder), "OMP_NUM_THREADS": "1"},
        cwd=folder,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )


def ask(worker: subprocess.Popen[str], name: str, size: int) -> float:
    """The seconds of one turn."""
    assert worker.stdin is not None
    assert worker.stdout is not None
    worker.stdin.write(f"{name} {size}\n")
    worker.stdin.flush()
    return float(worker.stdout.readline())


def measure_round(config: Config) -> dict[tuple[int, str], tuple[float, float]]:
    """Median seconds and median ratio of each size and loss, from one process for each checkout."""
    here = Path(__file__).resolve().parents[1]
    cases = [(size, name) for size in config.sizes for name in make_losses()]
    pairs: dict[tuple[int, str], list[list[float]]] = {case: [] for case in cases}
    with TemporaryDirectory() as folder:
        workers = [
            start_worker(root, Path(folder) / name, config)
            for name, root in (("mine", here), ("other", config.against))
        ]
        for turn in range(config.turns):
            # Each is the first as often as the second.
            order = (0, 1) if turn % 2 else (1, 0)
            for size, name in cases:
                seconds = {index: ask(workers[index], name, size) for index in order}
                pairs[size, name].append([seconds[0], seconds[1]])
        for worker in workers:
            worker.terminate()
    return {
        case: (median(mine for mine, _ in turns), median(mine / other for mine, other in turns))
        for case, turns in pairs.items()
    }


def main(config: Config) -> None:
    """Prints milliseconds and ratios."""
    if config.worker:
        serve(config)
        return
    rounds = [measure_round(config) for _ in range(config.rounds)]
    for size, name in rounds[0]:
        seconds, ratios = zip(*(measured[size, name] for measured in rounds), strict=True)
        print(
            f"{size:4} {name:24} {1e3 * median(seconds):6.3f} ms {median(ratios):6.3f} x"
            f"  ({min(ratios):.3f} to {max(ratios):.3f})"
        )


if __name__ == "__main__":
    main(tyro.cli(Config))
