"""Tables in Markdown, and what fills them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any


def markdown(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Returns a Markdown table; each row has a cell for each head."""
    rows = [heads, *rows]
    assert {len(row) for row in rows} == {len(heads)}
    head, *body = (f"|{'|'.join(f' {cell} ' if cell else ' ' for cell in row)}|" for row in rows)
    return "\n".join([head, "|---" * len(heads) + "|", *body])


def each(runs: Iterable[Mapping[str, Any]], name: str, part: str = "evaluation") -> list[float]:
    """Returns a figure of each run, without its interval."""
    return [run[part][name][0] for run in runs]


def shown_cost(cost: float, limit: float) -> str:
    """A cost for a table, bold above its limit."""
    return f"**{cost:.2f}**" if cost > limit else f"{cost:.2f}"
