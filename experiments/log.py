"""The figures of each batch of a run: in memory, in its checkpoints and in TorchRL's logger."""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from statistics import fmean
from time import perf_counter
from typing import Any

from tensordict import TensorDictBase
from torchrl.objectives import LossModule
from torchrl.record.loggers import get_logger

# What a run uses.
_PACKAGES = ("torch", "torchrl", "pybullet", "mujoco", "daqp", "gymnasium", "safety-gymnasium")


class Log:
    """A TorchRL logger for runs that can be resumed.

    A resumed run repeats the batches since its last checkpoint and would log them twice. So it
    begins the logger's files anew, with the rows of the checkpoint.

    Args:
        backend: name of TorchRL's logger.
        folder: folder of logs.
        name: name of the run in it.
    """

    def __init__(self, backend: str, folder: Path, name: str) -> None:
        self.rows: list[dict[str, float]] = []
        #: Seconds that the processes before this one have taken.
        self.seconds_before = 0.0
        self._start = perf_counter()
        self._backend, self._folder, self._name = backend, folder, name

    @property
    def frames(self) -> int:
        """Control steps so far."""
        return int(self.rows[-1]["frames"]) if self.rows else 0

    @property
    def seconds(self) -> float:
        """Seconds so far, in all processes that the run has had."""
        return self.seconds_before + perf_counter() - self._start

    def open(self) -> None:
        """Starts the logger."""
        shutil.rmtree(self._folder / self._name, ignore_errors=True)
        self._logger = get_logger(self._backend, str(self._folder), self._name)
        for row in self.rows:
            self._write(row)

    def add(self, row: dict[str, float]) -> None:
        """Adds a row of figures, among them ``frames``."""
        self.rows.append(row)
        self._write(row)

    def _write(self, row: dict[str, float]) -> None:
        figures = {name: value for name, value in row.items() if name != "frames"}
        self._logger.log_metrics(figures, step=row["frames"])

    def state_dict(self) -> dict[str, Any]:
        return {"rows": list(self.rows), "seconds": self.seconds}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self.rows = list(state_dict["rows"])
        self.seconds_before = state_dict["seconds"]


def figures(
    episodes: TensorDictBase, loss: LossModule, cost_names: Sequence[str]
) -> dict[str, float]:
    """Means over the episodes that ended in a batch (none if no episode did), and multipliers."""
    buffers = dict(loss.named_buffers())
    multipliers = {}
    if "lagrange_multiplier" in buffers:
        values = buffers["lagrange_multiplier"].tolist()
        multipliers = {f"multiplier/{n}": v for n, v in zip(cost_names, values, strict=True)}
    if not len(episodes):
        return multipliers
    costs = episodes["episode_cost"].mean(0).tolist()
    success = episodes.get("success", None)
    return {
        "return": episodes["episode_reward"].mean().item(),
        **{f"cost/{name}": cost for name, cost in zip(cost_names, costs, strict=True)},
        **({"success": success.float().mean().item()} if success is not None else {}),
        **multipliers,
    }


def summed_costs(
    batch: TensorDictBase, rows: Sequence[dict[str, float]], cost_names: Sequence[str]
) -> dict[str, float]:
    """Costs of all control steps of a run, up to and with those of a batch."""
    sums = batch["next", "cost"].flatten(0, -2).double().sum(0).tolist()
    before = rows[-1] if rows else {}
    return {
        f"summed/{name}": before.get(f"summed/{name}", 0.0) + value
        for name, value in zip(cost_names, sums, strict=True)
    }


def progress_text(row: Mapping[str, float], limits: Mapping[str, float]) -> str:
    """Returns the figures of a batch in a few words, each cost beside its limit.

    Examples:
        >>> row = {"success": 0.9, "return": -2.0, "cost/collision": 0.734}
        >>> progress_text(row, {"collision": 0.5})
        'collision 0.73 (limit 0.5), success 90 %, return -2.00'
    """
    words = [
        f"{name} {row[f'cost/{name}']:.2f} (limit {limit:g})"
        for name, limit in limits.items()
        if f"cost/{name}" in row
    ]
    if "success" in row:
        words.append(f"success {row['success']:.0%}".replace("%", " %"))
    if "return" in row:
        words.append(f"return {row['return']:.2f}")
    return ", ".join(words) or "no episode has ended yet"


def score(rows: Sequence[dict[str, float]], limits: Mapping[str, float]) -> float | None:
    """Mean return of some batches, if each of their mean costs is within its limit."""
    ended = [row for row in rows if "return" in row]
    if not ended or any(
        fmean(row[f"cost/{name}"] for row in ended) > limit for name, limit in limits.items()
    ):
        return None
    return fmean(row["return"] for row in ended)


def versions(packages: Sequence[str] = _PACKAGES) -> dict[str, str]:
    """What the figures of a run depend on beside its settings: versions of what is installed."""
    found = {}
    for name in packages:
        with suppress(PackageNotFoundError):
            found[name] = version(name)
    return found
