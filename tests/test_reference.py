"""Every public name has an entry in the API reference, and one line that says what it is."""

import inspect
import re
import sys
from importlib import import_module
from pathlib import Path

import pytest

DOCS = Path(__file__).parent.parent / "docs"
sys.path.insert(0, str(DOCS / "_ext"))

from names import MODULES, public_names  # noqa: E402

# Hydra's configurations are asked for by name only.
EVERY = [*MODULES, "torchrl_safe.trainers.configs"]


def documented():
    """The names with an entry, by module."""
    found = {}
    for page in DOCS.glob("reference/*.rst"):
        module = None
        for line in page.read_text(encoding="utf-8").splitlines():
            if match := re.match(r"\.\. currentmodule:: (\S+)", line):
                module = match[1]
            elif match := re.match(r"\.\. auto(?:class|exception|function|data):: (\S+)", line):
                found.setdefault(module, []).append(match[1])
    return found


@pytest.mark.parametrize("module", EVERY)
def test_every_public_name_has_one_entry(module):
    assert sorted(documented()[module]) == sorted(public_names(module))


@pytest.mark.parametrize("module", EVERY)
def test_every_class_and_function_has_a_summary_that_stands_alone(module):
    loaded = import_module(module)
    for name in public_names(module):
        member = getattr(loaded, name)
        if inspect.isclass(member) or inspect.isfunction(member):
            summary, *rest = inspect.getdoc(member).splitlines()
            assert summary.endswith("."), name
            assert not rest or not rest[0], name


def test_every_page_is_in_the_index():
    index = DOCS.joinpath("index.md").read_text(encoding="utf-8")
    listed = {line for line in index.splitlines() if re.fullmatch(r"[\w/]+", line)}
    pages = {
        str(page.relative_to(DOCS).with_suffix(""))
        for page in DOCS.rglob("*.md")
        if "_build" not in page.parts and "tutorials" not in page.parts
    }
    assert listed - {"tutorials/index", "reference/index"} == pages - {"index"}
