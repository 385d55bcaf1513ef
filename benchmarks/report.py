"""What is measured, and how it is written down."""

from __future__ import annotations

import dataclasses
import json
import os
import platform
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

from experiments.files import write_whole
from experiments.log import versions
from experiments.tables import markdown

_PACKAGES = (
    "torch", "torchrl", "tensordict", "pybullet", "mujoco", "gymnasium", "numpy", "panda-gym",
    "stable-baselines3", "ray",
    # Without it, tensordict looks for it on the disk whenever a module writes a key.
    "pandas",
)  # fmt: skip


@dataclass(frozen=True)
class Figure:
    """One measured number and the bar that it is to clear, if there is one.

    Args:
        name: what was measured.
        median: median of the rounds.
        low: first quartile.
        high: third quartile.
        unit: unit; x is a ratio.
        at_least: the bar, if more is better.
        at_most: the bar, if less is better.
    """

    name: str
    median: float
    low: float
    high: float
    unit: str
    at_least: float | None = None
    at_most: float | None = None

    @property
    def bar(self) -> str:
        """The bar in words."""
        if self.at_least is not None:
            return f"at least {self.at_least:g}"
        return "" if self.at_most is None else f"at most {self.at_most:g}"

    @property
    def verdict(self) -> str:
        """Whether the median clears the bar."""
        if not self.bar:
            return ""
        low = -float("inf") if self.at_least is None else self.at_least
        high = float("inf") if self.at_most is None else self.at_most
        return "met" if low <= self.median <= high else "missed"


def record(part: str, figures: Sequence[Figure], out: Path) -> None:
    """Adds a part to ``results.json``, or replaces it, and writes ``table.md`` anew.

    Args:
        part: name of the part.
        figures: what it has measured.
        out: folder of both files.
    """
    out.mkdir(parents=True, exist_ok=True)
    file = out / "results.json"
    results: dict[str, Any] = json.loads(file.read_text()) if file.exists() else {}
    results[part] = {
        **machine(),
        "figures": [
            {**dataclasses.asdict(figure), "verdict": figure.verdict} for figure in figures
        ],
    }
    write_whole(file, json.dumps(results, indent=1))
    text = "\n\n".join(_section(*item) for item in results.items()) + "\n"
    write_whole(out / "table.md", text)


def machine() -> dict[str, Any]:
    """Date, versions and processor."""
    return {
        "date": datetime.now(timezone.utc).isoformat(timespec="minutes"),
        "python": platform.python_version(),
        "cpu": f"{_processor()}, {os.cpu_count()} cores",
        "versions": versions(_PACKAGES),
    }


def table(figures: Sequence[Figure]) -> str:
    """A Markdown table of figures."""
    rows = [
        (
            figure.name,
            f"{figure.median:.3g} {figure.unit}",
            f"{figure.low:.3g} to {figure.high:.3g}",
            figure.bar,
            figure.verdict,
        )
        for figure in figures
    ]
    return markdown(("", "median", "quartiles", "target", ""), rows)


def _section(part: str, results: dict[str, Any]) -> str:
    figures = [
        Figure(**{key: value for key, value in row.items() if key != "verdict"})
        for row in results["figures"]
    ]
    versions = ", ".join(f"{name} {number}" for name, number in results["versions"].items())
    where = f"{results['date']}, {results['cpu']}, Python {results['python']}, {versions}."
    return f"## {part}\n\n{where}\n\n{table(figures)}"


def _processor() -> str:
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    names = [line.split(":")[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()
