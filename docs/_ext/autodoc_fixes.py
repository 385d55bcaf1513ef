"""True signatures and descriptions, where autodoc by itself shows others."""

from __future__ import annotations

import re
import sys
from typing import Any

from docutils.nodes import Element
from sphinx.application import Sphinx
from sphinx.ext.autodoc.preserve_defaults import update_defvalue
from sphinx.pycode import ModuleAnalyzer
from sphinx.util.inspect import signature, stringify_signature
from sphinx.util.logging import getLogger

LOGGER = getLogger(__name__)
UNKNOWN = "(*args, **kwargs)"
# What NumPy writes for an array; descriptions give the shape.
ARRAY = re.compile(r"(ndarray)\[tuple\[[^\]]*\], [~\w.]*dtype\[[^\]]*\]\]")


def constructor(
    app: Sphinx, what: str, name: str, obj: Any, options: Any, args: str | None, returns: str | None
) -> tuple[str, None] | None:
    """The signature of ``__init__``, where TorchRL hides it.

    TorchRL makes environments with a metaclass that has a ``__call__`` of its own, and losses with
    a ``__new__``. Autodoc shows the signature of these: ``(*args, **kwargs)``.
    """
    if not isinstance(obj, type) or args != UNKNOWN:
        return None
    if getattr(obj, "_is_protocol", False):
        return "", None
    # As it is written: `physics=Bullet()`, not what it evaluates to.
    update_defvalue(app, obj.__init__, bound_method=True)
    shown = stringify_signature(signature(obj.__init__, bound_method=True), show_annotation=False)
    if shown == UNKNOWN:
        LOGGER.warning("%s has no signature", name)
    return shown, None


def comment(app: Sphinx, what: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:
    """The ``#:`` comment of a constant that another module makes public."""
    attribute = name.rpartition(".")[2]
    if what != "data":
        return
    for module in [name for name in sys.modules if name.startswith("torchrl_safe.")]:
        if vars(sys.modules[module]).get(attribute) is not obj:
            continue
        found = ModuleAnalyzer.for_module(module).find_attr_docs().get(("", attribute))
        if found:
            lines[:] = found


# Napoleon reads the text before a colon in a property's first line as its type. Here it never is.
_DESCRIPTIONS: dict[str, list[str]] = {}
_PROPERTIES = {"property", "attribute", "data"}


def keep(app: Sphinx, what: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:
    """Remembers how a description reads."""
    if what in _PROPERTIES:
        _DESCRIPTIONS[name] = list(lines)


def restore(app: Sphinx, what: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:
    """Undoes what Napoleon took for a type."""
    if what in _PROPERTIES:
        kept = _DESCRIPTIONS.pop(name)
        if any(line.startswith(":type:") for line in lines):
            lines[:] = kept


def shorten(app: Sphinx, domain: str, objtype: str, content: Element) -> None:
    """Writes ``numpy.ndarray`` for the type of an array."""
    for types in app.env.current_document.autodoc_annotations.values():
        for name, shown in types.items():
            types[name] = ARRAY.sub(r"\1", shown)


def setup(app: Sphinx) -> dict[str, bool]:
    """Connects the corrections, those of properties around Napoleon."""
    app.setup_extension("sphinx.ext.autodoc")
    app.connect("autodoc-process-signature", constructor)
    app.connect("object-description-transform", shorten, priority=400)  # Before autodoc.
    app.connect("autodoc-process-docstring", comment, priority=300)
    app.connect("autodoc-process-docstring", keep, priority=400)  # Before Napoleon,
    app.connect("autodoc-process-docstring", restore, priority=600)  # and after.
    return {"parallel_read_safe": True, "parallel_write_safe": True}
