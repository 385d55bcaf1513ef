"""Files that are written whole or not at all."""

from __future__ import annotations

import os
from pathlib import Path

#: Suffix of what is being written.
UNFINISHED = ".unfinished"


def write_whole(path: Path, text: str) -> None:
    """Writes a file so that a program that is stopped leaves no half of it behind."""
    unfinished = path.with_suffix(UNFINISHED)
    with unfinished.open("w") as file:
        file.write(text)
        file.flush()
        os.fsync(file.fileno())
    unfinished.replace(path)
