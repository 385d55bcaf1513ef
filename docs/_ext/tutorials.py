"""Links to the file of a tutorial become links to its page: they work in a clone as well."""

from __future__ import annotations

import re

from sphinx.application import Sphinx

LINK = re.compile(r"\]\(\.\./((?:\.\./)*tutorials/\w+)\.py\)")


def point_to_pages(app: Sphinx, name: str, source: list[str]) -> None:
    """Rewrites the links of a page: its folder has the pages of the tutorials at build time."""
    source[0] = LINK.sub(r"](\1)", source[0])


def setup(app: Sphinx) -> dict[str, bool]:
    """Rewrites pages as they are read."""
    app.connect("source-read", point_to_pages)
    return {"parallel_read_safe": True}
