"""Tables in Markdown."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any


def markdown(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Returns a table of some columns."""
    head, *body = (f"| {' | '.join(row)} |" for row in (heads, *rows))
    return "\n".join([head, "|---" * len(heads) + "|", *body])


def each(runs: Iterable[Mapping[str, Any]], name: str, part: str = "evaluation") -> list[float]:
    """Returns a figure of each run, without its interval."""
    return [run[part][name][0] for run in runs]


def shown_cost(cost: float, limit: float) -> str:
    """A cost for a table, bold above its limit."""
    return f"**{cost:.2f}**" if cost > limit else f"{cost:.2f}"
