"""Files and folders of a run."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

from torchrl_safe._files import UNFINISHED, writing
from torchrl_safe.checkpoint import refuse_other_settings


def write_whole(path: Path, text: str) -> None:
    """Writes a text, whole or not at all."""
    with writing(path) as file:
        file.write(text.encode())


def as_json(config: Any) -> dict[str, Any]:
    """The settings of a run, a dataclass, as a file has them."""
    return json.loads(json.dumps(dataclasses.asdict(config), default=str))


def lasting(settings: Mapping[str, Any], changeable: Collection[str]) -> dict[str, Any]:
    """Those settings that a run keeps when it is resumed."""
    return {name: value for name, value in settings.items() if name not in changeable}


def run_to_resume(config: Any, changeable: Collection[str]) -> dict[str, Any] | None:
    """What the run in the folder ``config.out`` has finished; None if this begins one.

    Args:
        config: the settings, a dataclass with ``out`` and ``resume``.
        changeable: names of settings that may have changed.

    Raises:
        FileExistsError: if the folder has something in it, and no run that is to be resumed.
        ValueError: if that run has other settings, such as those of another script.
    """
    path = config.out / "results.json"
    before: dict[str, Any] = {}
    if config.resume and path.exists():
        before = json.loads(path.read_text())
    if before and "runs" not in before:  # Those of a grid have several.
        was, now = (lasting(each, changeable) for each in (before["config"], as_json(config)))
        refuse_other_settings(was, now)
        return before
    to_resume = "To resume the run in it, add --resume with the same options."
    require_new(config.out, "There is no run in it to resume." if config.resume else to_resume)
    if config.resume:
        print(f"There is no run in {config.out} to resume: this begins one.")
    return None


def require_new(folder: Path, hint: str = "") -> None:
    """Refuses a folder that holds more than what a killed program did not finish."""
    if folder.exists() and any(file.suffix != UNFINISHED for file in folder.iterdir()):
        message = f"out must be a new or empty folder, got {str(folder)!r}. {hint}"
        raise FileExistsError(message.strip())
