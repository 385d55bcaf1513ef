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


def entries():
    """Module and name of each entry, once by itself and once with the members that it names."""
    for page in DOCS.glob("reference/*.rst"):
        module = name = None
        for line in page.read_text(encoding="utf-8").splitlines():
            if match := re.match(r"\.\. currentmodule:: (\S+)", line):
                module = match[1]
            elif match := re.match(r"\.\. auto(?:class|exception|function|data):: (\S+)", line):
                name = match[1]
                yield module, name, []
            elif match := re.match(r"   :members: (.+)", line):
                yield module, name, match[1].split(", ")


def documented():
    """The names with an entry, by module."""
    found = {}
    for module, name, members in entries():
        if not members:
            found.setdefault(module, []).append(name)
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


def test_every_member_that_a_page_names_has_a_docstring_of_its_own():
    """Sphinx leaves out the others without a word: ``autodoc_inherit_docstrings`` is off."""
    named = [(m, n, member) for m, n, members in entries() for member in members]
    for module, name, member in named:
        documented_class = getattr(import_module(module), name)
        assert getattr(documented_class, member).__doc__, f"{name}.{member}"
    assert len(named) > 40


def test_every_name_that_a_docstring_points_to_has_an_entry():
    """Sphinx shows a reference that leads nowhere as plain text, without a word."""
    members = [(m, n, member) for m, n, several in entries() for member in [None, *several]]
    targets = {f"{m}.{n}" if member is None else f"{m}.{n}.{member}" for m, n, member in members}
    names = {target.rsplit(".", 1)[1] for target in targets}
    found = 0
    for module, name, member in members:
        owner = getattr(import_module(module), name)
        described = owner if member is None else getattr(owner, member)
        docstring = inspect.getdoc(described) or ""
        for target in re.findall(r":(?:func|class|meth|data):`~?\.?([\w.]+)`", docstring):
            if target.startswith("torchrl_safe"):
                found += 1
                assert target in targets, f"{name}: {target}"
            elif "." not in target:
                assert target in names or target in dir(owner), f"{name}: {target}"
    assert found > 50


def test_every_page_is_in_the_index():
    index = DOCS.joinpath("index.md").read_text(encoding="utf-8")
    listed = {line for line in index.splitlines() if re.fullmatch(r"[\w/]+", line)}
    pages = {
        str(page.relative_to(DOCS).with_suffix(""))
        for page in DOCS.rglob("*.md")
        if "_build" not in page.parts and "tutorials" not in page.parts
    }
    assert listed - {"tutorials/index", "reference/index"} == pages - {"index"}
