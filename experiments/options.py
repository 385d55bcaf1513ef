"""The options of ``make train``, in groups and in one line each."""

from __future__ import annotations

import ast
import inspect
import re
import textwrap
import types
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, get_args, get_origin, get_type_hints

_WIDTH, _COLUMN = 100, 36


def check_once(name: str, values: Sequence[Any]) -> None:
    """Raises ValueError unless an option names at least one thing, each once."""
    # Files are named by six digits of a fraction.
    named = {f"{value:g}" if isinstance(value, float) else str(value) for value in values}
    if not values or len(named) < len(values):
        raise ValueError(f"{name} must name at least one, each once, got {values}.")


def short_help(config: Any, groups: Mapping[str, Sequence[str]]) -> str:
    """Returns a line for each option: its default, and what it is.

    Args:
        config: a dataclass with the defaults. A field is described by the string below it, of which
            the part before the first full stop, colon or semicolon is shown.
        groups: names of fields by the titles they stand under.
    """
    described, hints = descriptions(type(config)), get_type_hints(type(config))
    lines = []
    for title, names in groups.items():
        lines += ["", title]
        for name in names:
            value = getattr(config, name)
            option = f"  --{name.replace('_', '-')} {_shown(value, hints[name])}".rstrip()
            text = re.split(r"[.:;] |[.]$", described[name])[0]
            choices = _choices(hints[name])
            wide = f"{text}: {', '.join(choices)}" if choices else text
            if choices and len(wide) <= _WIDTH - _COLUMN:
                text = wide
            gap = " " * max(2, _COLUMN - len(option))
            room = _WIDTH - len(option + gap)
            while len(text) > room and ", " in text:
                text = text.rpartition(", ")[0]
            lines.append(option + gap + textwrap.shorten(text, room, placeholder=" ..."))
    return "\n".join(lines[1:])


def descriptions(kind: type) -> dict[str, str]:
    """Returns the strings below the fields of a dataclass, by the names of the fields."""
    (body,) = ast.parse(textwrap.dedent(inspect.getsource(kind))).body
    assert isinstance(body, ast.ClassDef)
    return {
        field.target.id: " ".join(text.value.value.split())
        for field, text in zip(body.body, body.body[1:], strict=False)
        if isinstance(field, ast.AnnAssign)
        and isinstance(field.target, ast.Name)
        and isinstance(text, ast.Expr)
        and isinstance(text.value, ast.Constant)
        and isinstance(text.value.value, str)
    }


def _shown(value: Any, hint: Any) -> str:
    """A default as it would be given, or what is to be given."""
    match value:
        case True | False:
            return ""
        case None:
            return "N" if int in get_args(hint) else "NAME"
        case Path():
            return "FOLDER"
        case tuple():
            return " ".join(map(str, value))
        case dict():
            return " ".join(f"{name} {limit:g}" for name, limit in value.items()) or "NAME LIMIT"
        case float():
            return f"{value:g}"
    return str(value)


def _choices(hint: Any) -> tuple[str, ...]:
    if get_origin(hint) is Literal:
        return get_args(hint)
    if isinstance(hint, types.UnionType):
        return next((_choices(each) for each in get_args(hint) if _choices(each)), ())
    return ()
