"""Every link within the site leads somewhere, and nothing is loaded from elsewhere."""

from __future__ import annotations

from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

from sphinx.application import Sphinx
from sphinx.errors import ExtensionError

# Pages that Sphinx writes for itself.
OWN = {"genindex.html", "search.html", "py-modindex.html"}


class Page(HTMLParser):
    """The anchors of a page, what it links to and what it loads."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.anchors: set[str] = set()
        self.links: list[str] = []
        self.loads: list[str] = []
        self.feed(path.read_text(encoding="utf-8"))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = dict(attrs)
        for key in ("id", "name"):
            if given.get(key):
                self.anchors.add(given[key] or "")
        target = given.get("href") or given.get("src")
        if target and tag in {"a", "area"}:
            self.links.append(target)
        elif target and given.get("rel") not in {"next", "prev", "search", "index"}:
            self.loads.append(target)


def check(app: Sphinx, error: Exception | None) -> None:
    """Refuses dead links, and files that a page would need a network for."""
    if error is not None or app.builder.format != "html":
        return
    pages = {path: Page(path) for path in Path(app.outdir).resolve().rglob("*.html")}
    faults = []
    for path, page in pages.items():
        faults += [f"{path.name} loads {url}" for url in page.loads if urlsplit(url).netloc]
        for target in page.links:
            parts = urlsplit(target)
            if parts.scheme or parts.netloc or path.name in OWN:
                continue
            file = (path.parent / unquote(parts.path)).resolve() if parts.path else path
            anchors = pages[file].anchors if file in pages else {unquote(parts.fragment)}
            if not file.exists() or (parts.fragment and unquote(parts.fragment) not in anchors):
                faults.append(f"{path.name} links to {target}, which does not exist")
    if faults:
        raise ExtensionError("\n".join(faults))


def setup(app: Sphinx) -> dict[str, bool]:
    """Checks the site when it is built."""
    app.connect("build-finished", check)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
