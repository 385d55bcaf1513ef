"""Runs the benchmarks: ``make bench``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import tyro

from benchmarks.parts import PARTS, Part, measure_apart
from benchmarks.report import record, table


@dataclass(frozen=True)
class Config:
    """Measure ratios against the physics floor, other libraries and hand-written code."""

    parts: tuple[Part, ...] = PARTS
    """What to measure."""
    quick: bool = False
    """Only try whether everything runs: the figures mean nothing, and are not written down."""
    out: Path = Path("runs/benchmarks")
    """Folder of results.json and table.md; parts that are not measured keep their figures."""


def main(config: Config) -> None:
    """Measures part by part, and writes down each at once."""
    for part in config.parts:
        figures = measure_apart(part, quick=config.quick)
        if not config.quick:
            record(part, figures, config.out)
        print(f"## {part}\n\n{table(figures)}\n", flush=True)


if __name__ == "__main__":
    main(tyro.cli(Config))
