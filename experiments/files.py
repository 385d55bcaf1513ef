"""Files and folders of a run."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

from torchrl_safe._files import UNFINISHED, writing

#: What to do about a folder that a run may have been stopped in.
TO_RESUME = "To resume the run in it, add --resume with the same options."


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


def require_new(folder: Path, hint: str = "") -> None:
    """Refuses a folder that holds more than what a killed program did not finish."""
    if folder.exists() and any(file.suffix != UNFINISHED for file in folder.iterdir()):
        message = f"out must be a new or empty folder, got {str(folder)!r}. {hint}"
        raise FileExistsError(message.strip())
