"""Public names in code style become links to the reference, so that pages stay plain Markdown.

``ArmEnv``, ``Collision(table=True)`` and ``PIDControl.step`` are linked wherever they stand, unless
they are in a heading or a link already.
"""

from __future__ import annotations

import re
from importlib import import_module

from docutils import nodes
from sphinx.addnodes import desc_signature, pending_xref
from sphinx.application import Sphinx
from sphinx.transforms import SphinxTransform

MODULES = [
    "torchrl_safe.envs",
    "torchrl_safe.envs.gym",
    "torchrl_safe.objectives",
    "torchrl_safe.policy",
    "torchrl_safe.evaluation",
    "torchrl_safe.metrics",
    "torchrl_safe.checkpoint",
    "torchrl_safe.collectors",
    "torchrl_safe.trainers",
    "torchrl_safe.testing",
]
# Words that are public names of `metrics` and much else besides.
ORDINARY = {"mean", "share"}
NAME = re.compile(r"(?:(?:torchrl_safe\.)?testing\.)?([A-Za-z]\w+)(?:\.(\w+))?(?:\(.*\))?", re.S)


def public_names(module: str) -> list[str]:
    """What a module offers: its ``__all__``, or what it defines without an underscore."""
    loaded = import_module(module)
    if hasattr(loaded, "__all__"):
        return list(loaded.__all__)
    return [
        name
        for name, value in vars(loaded).items()
        if not name.startswith("_") and getattr(value, "__module__", None) == module
    ]


class LinkNames(SphinxTransform):
    """Wraps code that is a public name in a reference to it."""

    default_priority = 500
    _places: dict[str, str] | None = None

    def apply(self, **kwargs: object) -> None:
        if LinkNames._places is None:
            LinkNames._places = {
                name: f"{module}.{name}"
                for module in MODULES
                for name in public_names(module)
                if name not in ORDINARY
            }
        for literal in list(self.document.findall(nodes.literal)):
            if self._is_linked(literal):
                continue
            match = NAME.fullmatch(literal.astext())
            if match is None or match[1] not in LinkNames._places:
                continue
            target = ".".join(filter(None, [LinkNames._places[match[1]], match[2]]))
            link = pending_xref(
                "", refdomain="py", reftype="obj", reftarget=target, refexplicit=True
            )
            link["refdoc"] = self.env.docname
            literal.parent.replace(literal, link)
            link += literal

    @staticmethod
    def _is_linked(node: nodes.Node) -> bool:
        while node.parent is not None:
            node = node.parent
            if isinstance(node, nodes.reference | pending_xref | nodes.title | desc_signature):
                return True
        return False


def setup(app: Sphinx) -> dict[str, bool]:
    """Adds the links to every page."""
    app.add_transform(LinkNames)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
