"""Formulas as MathML, which browsers draw themselves: no script, no font, no network."""

from __future__ import annotations

from typing import Any

from docutils import nodes
from latex2mathml.converter import convert
from sphinx.application import Sphinx
from sphinx.util import logging
from sphinx.util.math import get_node_equation_number

_LOGGER = logging.getLogger(__name__)


def mathml(node: nodes.math | nodes.math_block, **options: str) -> str:
    """Converts a formula; lines that end in two backslashes are aligned, as Sphinx has it.

    A command that the converter does not know is a warning: it would be printed as it stands.
    """
    formula = node.astext().strip()
    if r"\\" in formula and r"\begin" not in formula:
        formula = rf"\begin{{split}}{formula}\end{{split}}"
    converted = convert(formula, **options)
    if ">\\" in converted or ">&<" in converted:
        _LOGGER.warning("formula that MathML does not show: %s", formula, location=node)
    return converted


def visit_math(self: Any, node: nodes.math) -> None:
    """Writes a formula within a line."""
    self.body.append(mathml(node))
    raise nodes.SkipNode


def visit_math_block(self: Any, node: nodes.math_block) -> None:
    """Writes a formula on a line of its own."""
    self.body.append(self.starttag(node, "div", CLASS="math"))
    if node.get("number"):
        self.body.append(f'<span class="eqno">({get_node_equation_number(self, node)})</span>')
    self.body.append(mathml(node, display="block"))
    self.body.append("</div>")
    raise nodes.SkipNode


def setup(app: Sphinx) -> dict[str, bool]:
    """Adds the renderer ``mathml``."""
    app.add_html_math_renderer("mathml", (visit_math, None), (visit_math_block, None))
    return {"parallel_read_safe": True, "parallel_write_safe": True}
