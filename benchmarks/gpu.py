"""One optimizer step on a GPU against TorchRL's PPO, hand-written code and the same step on a CPU.

::

    python -m benchmarks.gpu
"""

from __future__ import annotations

from collections.abc import Iterator
from time import perf_counter

import torch

from benchmarks.networks import make_minibatch
from benchmarks.report import Figure, machine, table
from benchmarks.timing import Contender, quartiles, race, ratio
from benchmarks.update import contenders

_SIZES = (64, 4096)
_KINDS = ("eager", "compiled")
_OURS = "PPOLagrangianLoss"


def finished() -> float:
    """The time at which the GPU has done all that it was asked for."""
    torch.cuda.synchronize()
    return perf_counter()


def measure(size: int) -> Iterator[Figure]:
    """Ratios for minibatches of one size, and the milliseconds behind them."""
    minibatch = make_minibatch(size)
    rivals: dict[str, Contender] = {}
    with torch._dynamo.config.patch(recompile_limit=64):
        for device in ("cuda", "cpu"):
            for kind in _KINDS:
                found = contenders(minibatch.to(device), kind, steps=10, clock=finished)
                rivals |= {f"{name}, {device}": contender for name, contender in found.items()}
    times = race(rivals, rounds=15)
    for kind in _KINDS:
        ours = times[f"{_OURS}, {kind}, cuda"]
        for rival in ("ClipPPOLoss", "hand-written"):
            yield ratio(
                f"minibatch {size}: {_OURS} / {rival}, {kind}, GPU",
                ours,
                times[f"{rival}, {kind}, cuda"],
            )
        yield ratio(
            f"minibatch {size}: {_OURS}, {kind}, CPU / GPU", times[f"{_OURS}, {kind}, cpu"], ours
        )
        yield quartiles(f"minibatch {size}: {_OURS}, {kind}, GPU", 1e3 * ours, "ms")


if __name__ == "__main__":
    torch.set_num_threads(1)
    torch.manual_seed(0)
    print(f"{torch.cuda.get_device_name()}, {machine()}")
    for size in _SIZES:
        print(table(list(measure(size))), flush=True)
