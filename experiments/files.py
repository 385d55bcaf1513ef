"""Files and folders of a run."""

from __future__ import annotations

from pathlib import Path

from torchrl_safe._files import UNFINISHED, writing


def write_whole(path: Path, text: str) -> None:
    """Writes a text, whole or not at all."""
    with writing(path) as file:
        file.write(text.encode())


def is_new(folder: Path) -> bool:
    """Whether a folder is missing or empty, but for what a killed program did not finish."""
    return not folder.exists() or all(file.suffix == UNFINISHED for file in folder.iterdir())
