"""Eager time of a minibatch for each on-policy loss, in this checkout and in another, in turn.

``python -m benchmarks.losses --against ../other`` prints a ratio for each loss: this checkout's
time over the other's, each the least of many turns, since other work on a machine only adds.
"""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from time import process_time

import torch
import tyro
from torchrl.objectives import A2CLoss, ClipPPOLoss, LossModule

import torchrl_safe.objectives as ours
from benchmarks.networks import make_actor, make_critic, make_minibatch


@dataclass(frozen=True)
class Config:
    """Compare this checkout's losses with another's."""

    against: Path = Path()
    """Root of the other checkout."""
    sizes: tuple[int, ...] = (64, 256)
    """Steps in a minibatch."""
    turns: int = 40
    """How often each loss is timed, in both checkouts."""
    calls: int = 10
    """Forward and backward passes in a turn."""
    worker: bool = False
    """Serve times to another process, one for each line that comes in."""


def make_losses() -> dict[str, LossModule]:
    """Every on-policy loss, with one cost."""
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
    return losses


def serve(config: Config) -> None:
    """Reads ``name size`` and answers with seconds, until the input ends."""
    torch.set_num_threads(1)
    losses = make_losses()
    batches = {}
    for size in config.sizes:
        batches[size] = make_minibatch(size)
        dist = torch.randn(size, 7), torch.ones(size, 7)
        batches[size]["loc"], batches[size]["scale"] = dist
    for line in sys.stdin:
        name, size = line.split()
        loss, batch = losses[name], batches[int(size)]
        start = process_time()
        for _ in range(config.calls):
            outputs = loss(batch)
            sum(value for key, value in outputs.items() if key.startswith("loss_")).backward()
        print((process_time() - start) / config.calls, flush=True)


def start_worker(root: Path, config: Config) -> subprocess.Popen[str]:
    """A process that has the losses of a checkout."""
    command = [sys.executable, __file__, "--worker", "--calls", str(config.calls)]
    command += ["--sizes", *map(str, config.sizes)]
    here = Path(__file__).resolve().parents[1]
    # This file's benchmarks package for both, the library of each.
    path = os.pathsep.join([str(root.resolve()), str(here)])
    return subprocess.Popen(
        command,
        env={**os.environ, "PYTHONPATH": path, "OMP_NUM_THREADS": "1"},
        cwd=root,
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


def main(config: Config) -> None:
    """Prints milliseconds and ratios."""
    if config.worker:
        serve(config)
        return
    here = Path(__file__).resolve().parents[1]
    workers = [start_worker(root, config) for root in (here, config.against)]
    names = list(make_losses())
    for size in config.sizes:
        least = {name: [float("inf")] * 2 for name in names}
        for _ in range(config.turns):
            for name in names:
                for index, worker in enumerate(workers):
                    least[name][index] = min(least[name][index], ask(worker, name, size))
        for name, (mine, other) in least.items():
            print(f"{size:4} {name:24} {1e3 * mine:6.3f} ms {mine / other:6.3f} x", flush=True)
    for worker in workers:
        worker.terminate()


if __name__ == "__main__":
    main(tyro.cli(Config))
