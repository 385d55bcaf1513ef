"""Puts suites that were run in several places into one: ``python -m experiments.suite_merge``.

``docs/results/suite.json`` has the runs of docs/benchmarks/suite.md. Add runs of yours, with the
same seeds of both algorithms::

    python -m experiments.suite_merge --results docs/results/suite.json runs/suite/results.json
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Sequence
from itertools import product
from pathlib import Path
from typing import Any

import tyro

from experiments.files import write_whole
from experiments.suite_report import draw
from torchrl_safe.envs import SUITE


@dataclasses.dataclass(frozen=True)
class Config:
    """Draw the tables and figures of all runs together."""

    results: tuple[Path, ...]
    """Files that make suite or this script has written; of a run in several, the last counts."""
    out: Path = Path("runs/suite-merged")
    """Folder of table.md, profiles.png, training.png and results.json."""


def merge(results: Sequence[Sequence[dict[str, Any]]]) -> list[dict[str, Any]]:
    """The runs of several suites, each once and as small as the figures allow.

    Ordered by task, algorithm and seed.

    Raises:
        ValueError: unless every algorithm has run on the same tasks with the same seeds.
    """
    found = {(run["task"], run["algorithm"], run["seed"]): run for runs in results for run in runs}
    tasks = sorted({task for task, *_ in found}, key=[*SUITE].index)
    algorithms = [*dict.fromkeys(algorithm for _, algorithm, _ in found)]
    seeds = {seed for *_, seed in found}
    if absent := [key for key in product(tasks, algorithms, seeds) if key not in found]:
        shown = "; ".join(" ".join(map(str, key)) for key in absent[:5])
        raise ValueError(
            f"results must have every algorithm on the same tasks and seeds, got none of {shown}"
            f"{' ...' if len(absent) > 5 else ''}."
        )
    order = sorted(found, key=lambda key: (tasks.index(key[0]), algorithms.index(key[1]), key[2]))
    return [_essence(found[key]) for key in order]


def _essence(run: dict[str, Any]) -> dict[str, Any]:
    """A run without its episodes, and of its history only what is summed."""
    history = [
        {key: value for key, value in row.items() if key == "frames" or key.startswith("summed/")}
        for row in run["history"]
    ]
    kept = ("task", "algorithm", "seed", "evaluation", "without_shield", "versions")
    return {**{name: run[name] for name in kept if name in run}, "history": history}


def main(config: Config) -> None:
    """Merges the runs, then writes them, a table and the figures."""
    runs = merge([json.loads(file.read_text())["runs"] for file in config.results])
    config.out.mkdir(parents=True, exist_ok=True)
    lines = ",\n".join(json.dumps(run) for run in runs)  # A line for each, for version control.
    write_whole(config.out / "results.json", f'{{"runs": [\n{lines}\n]}}\n')
    table = draw(runs, config.out)
    write_whole(config.out / "table.md", table)
    print(f"{table}\nResults are in {config.out}.")


if __name__ == "__main__":
    main(tyro.cli(Config))
