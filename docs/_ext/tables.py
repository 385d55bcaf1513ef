"""Numbers in tables stay on one line: ``3.57 [3.34, 3.82]``, ``99.6 %``, ``0.8 ± 0.1``."""

from __future__ import annotations

import re
from typing import Any

from docutils import nodes
from sphinx.application import Sphinx

# A space between two numbers, or between a number and its unit or interval.
BETWEEN_NUMBERS = re.compile(r"(?<=[\d,\]±]) (?=[\[(\d%±-])")


def keep_together(app: Sphinx, doctree: nodes.document, page: str) -> None:
    """Puts spaces that do not break into the cells of the tables."""
    for cell in doctree.findall(nodes.entry):
        for text in list(cell.findall(nodes.Text)):
            if not isinstance(text.parent, nodes.literal):
                text.parent.replace(
                    text, nodes.Text(BETWEEN_NUMBERS.sub("\N{NO-BREAK SPACE}", text))
                )


def setup(app: Sphinx) -> dict[str, Any]:
    """Connects it."""
    app.connect("doctree-resolved", keep_together)
    return {"parallel_read_safe": True}
