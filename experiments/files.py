"""Files and folders of a run."""

from __future__ import annotations

from pathlib import Path

from torchrl_safe._files import UNFINISHED, writing

#: What to do about a folder that a run may have been stopped in.
TO_RESUME = "To resume the run in it, add --resume with the same options."


def write_whole(path: Path, text: str) -> None:
    """Writes a text, whole or not at all."""
    with writing(path) as file:
        file.write(text.encode())


def require_new(folder: Path, hint: str = "") -> None:
    """Refuses a folder that holds more than what a killed program did not finish."""
    if folder.exists() and any(file.suffix != UNFINISHED for file in folder.iterdir()):
        message = f"out must be a new or empty folder, got {str(folder)!r}. {hint}"
        raise FileExistsError(message.strip())
