"""Files that are written whole or not at all."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

_UNFINISHED = ".unfinished"


@contextmanager
def writing(path: Path) -> Iterator[IO[bytes]]:
    """Opens a file that has its name only once it is complete and on the disk.

    A program that is stopped leaves no half of it behind, and what was there before until then.
    """
    unfinished = path.with_name(path.name + _UNFINISHED)
    try:
        with unfinished.open("wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        unfinished.replace(path)
    finally:
        unfinished.unlink(missing_ok=True)


def write_whole(path: Path, text: str) -> None:
    """Writes a text, whole or not at all."""
    with writing(path) as file:
        file.write(text.encode())


def is_new(folder: Path) -> bool:
    """Whether a folder is missing or empty, but for what a killed program did not finish."""
    return not folder.exists() or all(file.suffix == _UNFINISHED for file in folder.iterdir())
