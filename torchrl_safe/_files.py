"""Files that are written whole or not at all."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

#: Ending of a file that is not complete.
UNFINISHED = ".unfinished"


@contextmanager
def writing(path: Path) -> Iterator[IO[bytes]]:
    """Opens a file that gets its name only when it is complete and on the disk.

    A program that is stopped leaves no half-written file. The old file stays until then.
    """
    unfinished = path.with_name(path.name + UNFINISHED)
    try:
        with unfinished.open("wb") as file:
            yield file
        publish(unfinished, path)
    finally:
        unfinished.unlink(missing_ok=True)


def publish(written: Path, path: Path) -> None:
    """Gives a file its name, once all of it is on the disk."""
    with written.open("rb+") as file:
        os.fsync(file.fileno())
    os.replace(written, path)
    if os.name == "posix":  # Elsewhere a folder cannot be opened.
        folder = os.open(path.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)
