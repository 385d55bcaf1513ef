"""Checkpoints of a run that survive whatever stops it."""

from __future__ import annotations

import io
import json
import shutil
import warnings
from collections import OrderedDict
from collections.abc import Mapping
from dataclasses import dataclass
from numbers import Integral
from pathlib import Path
from pickle import UnpicklingError
from typing import Any, Protocol, runtime_checkable

import torch
from torch import Tensor
from torchrl.checkpoint import (
    Checkpoint,
    CheckpointError,
    CheckpointRotation,
    StateDictCheckpointAdapter,
)

from torchrl_safe._checks import check_kind, is_number
from torchrl_safe._files import UNFINISHED, publish

_PLAIN = (bool, int, float, str, type(None))


class RunCheckpoints:
    """The checkpoints of one run: the last ones and the best, each a file of its own.

    TorchRL's :class:`~torchrl.checkpoint.Checkpoint` reads and writes them, and its
    :class:`~torchrl.checkpoint.CheckpointRotation` chooses which to keep. This class makes them
    safe:

    - A file gets its name only when it is complete and on the disk: it is written under another
      name, synced, then renamed. A process killed at any time leaves the last checkpoint intact.
    - :meth:`load` takes the newest checkpoint that is whole (every file in it has a checksum)
      and of this run. It warns about those that it skips, and raises an error if none is left.
    - It reads tensors and plain values only, with ``weights_only``: loading runs no foreign code.
      (``Checkpoint.load`` alone unpickles what a foreign file may hold.)

    Args:
        folder (Path): folder of the checkpoints, which is made when the first is saved.
        components (Mapping[str, Any]): objects with ``state_dict`` and ``load_state_dict``, by
            name.

    Keyword Args:
        settings (Mapping[str, Any], optional): settings of the run, as JSON values. A checkpoint
            of a run with other settings is not loaded. Defaults to none.
        keep_last (int, optional): how many of the last checkpoints to keep. Defaults to ``2``:
            one to fall back on.

    Raises:
        TypeError: if ``components`` is not a mapping of objects with ``state_dict`` and
            ``load_state_dict``.
        ValueError: if it is empty.

    Examples:
        >>> import tempfile
        >>> import torch
        >>> folder = tempfile.mkdtemp()
        >>> net = torch.nn.Linear(1, 1)
        >>> checkpoints = RunCheckpoints(folder, {"net": net}, settings={"lr": 0.1})
        >>> checkpoints.load() is None  # A run that starts.
        True
        >>> checkpoints.save(1, score=0.5).name
        'checkpoint-000000000001.torchrl'
        >>> checkpoints.load()
        1
    """

    def __init__(
        self,
        folder: str | Path,
        components: Mapping[str, Any],
        *,
        settings: Mapping[str, Any] | None = None,
        keep_last: int = 2,
    ) -> None:
        check_kind("components", components, Mapping, such_as='{"loss": loss}')
        if not components:
            raise ValueError("components must have at least one object, got none.")
        for name, component in components.items():
            check_kind(f"components[{name!r}]", component, _Component)
        self.folder = Path(folder)
        # As they come back from a file: a tuple as a list.
        self.settings: dict[str, Any] = json.loads(json.dumps(settings or {}))
        self._rotation = CheckpointRotation(
            self.folder, keep_last=keep_last, keep_best=("score", "max")
        )
        self._checkpoint = _checkpoint_of(components)
        # What load has warned of, and why: the run goes on from before.
        self._skipped: dict[Path, str] = {}
        # What this run has written or loaded last.
        self._newest: Path | None = None

    def save(self, step: int, *, score: float | None = None) -> Path:
        """Saves all components.

        Args:
            step (int): how far the run is, in any unit; a later checkpoint has a larger one. Those
                that :meth:`load` has skipped are removed.
            score (float, optional): how good it is; the checkpoint with the highest is kept
                too. Without a score it is not the best.

        Returns:
            The file.

        Raises:
            TypeError: if a state has an object that :meth:`load` could not read, such as a number
                of NumPy.
            ValueError: if ``step`` is not a whole number of at most twelve digits, ``score`` is no
                number, or the folder has a checkpoint of a later step, or one of this step that
                another run has left.
            OSError: if it could not be written, for example because the disk is full; those
                before are intact. What a ``state_dict`` raises is raised as it is.
        """
        whole = isinstance(step, Integral) and not isinstance(step, bool)
        if not whole or not 0 <= step < 10**12:  # The digits that the name has.
            raise ValueError(
                f"step must be a whole number of at least 0, got {step!r}, and at most 12 digits."
            )
        if score is not None and not is_number(score):
            raise ValueError(f"score must be a number, got {score!r}.")
        path = self.folder / f"checkpoint-{step:012d}.torchrl"
        later = [file for file in self._files() if file.name > path.name]
        # A run may write its own last checkpoint again, and no other run's.
        others = [path, *later] if path.exists() and path != self._newest else later
        if foreign := [file.name for file in others if file not in self._skipped]:
            raise ValueError(
                f"step must be more than that of the newest checkpoint, got {step}, and "
                f"{self.folder} has {foreign[-1]}: load() resumes that run, clear() removes it."
            )
        parts = self._checkpoint.components
        taken = {name: _Taken(part.state_dict()) for name, part in parts.items()}
        for name, part in taken.items():
            _check_loadable(f"components[{name!r}].state_dict()", part.state)
        scores = {} if score is None else {"score": score}
        metadata = {"settings": self.settings, **scores}
        unfinished = self.folder / UNFINISHED
        self.folder.mkdir(parents=True, exist_ok=True)
        shutil.rmtree(unfinished, ignore_errors=True)  # Of a process that was killed.
        try:
            written = _checkpoint_of(taken).save(unfinished / path.name, metadata=metadata)
            publish(written, path)
        except (OSError, RuntimeError) as error:
            # torch.save's error does not mention the disk.
            free = shutil.disk_usage(self.folder).free
            raise OSError(
                f"Checkpoint {path} could not be written ({free:,} bytes are free there): {error}. "
                f"The newest before it is {self._rotation.latest()}."
            ) from error
        finally:
            shutil.rmtree(unfinished, ignore_errors=True)
        for file in later:
            file.unlink()
        self._rotation.prune()
        self._newest = path
        return path

    def load(self, *, map_location: Any = None) -> int | None:
        """Loads the newest checkpoint that can be used into all components.

        Keyword Args:
            map_location (optional): where :func:`torch.load` puts the tensors of the file, for
                example ``"cpu"`` for a run that had another device than there is now. Defaults to
                the device they were saved from.

        Returns:
            Its step, or None if there is no checkpoint.

        Raises:
            CheckpointError: if there are checkpoints, but none that can be used; it says of each
                why not. The components may have changed then.
        """
        self._skipped = {}
        for path in reversed(self._files()):
            try:
                step = self._load(path, map_location)
            except Exception as error:  # A torn file can raise any error in its readers.
                self._skipped[path] = f"{path}: {error}"
                continue
            self._newest = path
            if self._skipped:
                reasons = "\n".join(self._skipped.values())
                warnings.warn(f"Going on from {path}; not used:\n{reasons}", stacklevel=2)
            return step
        if self._skipped:
            reasons = "\n".join(self._skipped.values())
            raise CheckpointError(f"No checkpoint in {self.folder} can be used:\n{reasons}")
        return None

    def best(self) -> Path | None:
        """The checkpoint with the highest score, if any has one."""
        return self._rotation.best()

    def clear(self) -> None:
        """Removes all checkpoints, and nothing else that is in the folder."""
        shutil.rmtree(self.folder / UNFINISHED, ignore_errors=True)
        for path in self._files():
            path.unlink()

    def _files(self) -> list[Path]:
        return sorted(self.folder.glob("checkpoint-*.torchrl"))

    def _load(self, path: Path, map_location: Any) -> int:
        manifest = Checkpoint.manifest(path)
        refuse_other_settings(manifest["metadata"].get("settings", {}), self.settings)
        if more := manifest["components"].keys() - self._checkpoint.components.keys():
            raise CheckpointError(f"components must have {sorted(more)} too, which it saved")
        for name, component in manifest["components"].items():
            if component["files"] != [StateDictCheckpointAdapter.state_torch]:
                raise CheckpointError(
                    f"component {name!r} is not what this class writes, but {component['files']}"
                )
        self._checkpoint.load(path, map_location=map_location)
        return int(path.stem.removeprefix("checkpoint-"))


@runtime_checkable
class _Component(Protocol):
    """What has a state to be saved."""

    def state_dict(self) -> Any: ...

    def load_state_dict(self, state_dict: Any) -> Any: ...


@dataclass(frozen=True)
class _Taken:
    """A component whose state has been taken: errors of that are none of the disk."""

    state: Any

    def state_dict(self) -> Any:
        return self.state


def _check_loadable(name: str, state: Any) -> None:
    """Raises TypeError unless ``load`` can read a state: it takes no foreign classes."""
    if isinstance(state, Tensor) or type(state) in _PLAIN:
        return
    if type(state) in (dict, OrderedDict):
        for key, value in state.items():
            _check_loadable(f"a key of {name}", key)
            _check_loadable(f"{name}[{key!r}]", value)
    elif type(state) in (list, tuple):
        for index, value in enumerate(state):
            _check_loadable(f"{name}[{index}]", value)
    else:
        file = io.BytesIO()
        torch.save(state, file)
        file.seek(0)
        try:
            torch.load(file, weights_only=True)
        except UnpicklingError as error:
            raise TypeError(
                f"{name} must be a tensor or a plain value, or load() could not read it, got "
                f"{state!r} of {type(state)}: keep it as a number, a string or a tensor."
            ) from error


def _checkpoint_of(components: Mapping[str, Any]) -> Checkpoint:
    checkpoint = Checkpoint(format="archive")
    for name, component in components.items():
        checkpoint.register(name, component, adapter=StateDictCheckpointAdapter("torch"))
    return checkpoint


def refuse_other_settings(saved: Mapping[str, Any], settings: Mapping[str, Any]) -> None:
    """Compares the settings of a run that is to go on with those it had.

    Args:
        saved: the settings that the run had.
        settings: those it is to go on with.

    Raises:
        ValueError: if they differ; it names the settings and both values.

    Examples:
        >>> refuse_other_settings({"lr": 0.1}, {"lr": 0.2})
        Traceback (most recent call last):
        ...
        ValueError: the run has other settings: lr was 0.1 and is now 0.2
    """
    differences = [
        f"{name} was {saved.get(name)!r} and is now {settings.get(name)!r}"
        for name in dict.fromkeys((*settings, *saved))
        if _differs(saved.get(name), settings.get(name))
    ]
    if differences:
        raise ValueError(f"the run has other settings: {', '.join(differences)}")


def _differs(one: Any, other: Any) -> bool:
    """Also by the order of entries: costs, for example, are columns. NaN is like NaN."""
    if isinstance(one, Mapping) and isinstance(other, Mapping):
        return list(one) != list(other) or any(_differs(one[key], other[key]) for key in one)
    both_nan = one != one and other != other
    return one != other and not both_nan
