"""A trained policy in a file of its own: what is deployed, without critics and optimizers."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from tensordict.nn import TensorDictModuleBase

from experiments.agent import ActorSpec, make_actor
from experiments.files import writing

#: What a file of ours says it is; the number rises when its contents change.
_FORMAT, _VERSION = "torchrl-safe policy", 1


@dataclass(frozen=True)
class SavedPolicy:
    """A policy as it comes from a file.

    Args:
        actor: the policy. It explores unless told otherwise:
            ``with set_exploration_type(ExplorationType.DETERMINISTIC)``.
        spec: its shape.
        settings: how it was trained, as it was given to :func:`save_policy`.
    """

    actor: TensorDictModuleBase
    spec: ActorSpec
    settings: dict[str, Any]


def save_policy(
    path: Path, actor: TensorDictModuleBase, spec: ActorSpec, settings: dict[str, Any]
) -> None:
    """Writes a policy, all at once: another file of that name is there until this one is.

    Args:
        path: the file.
        actor: what :func:`~experiments.agent.make_actor` made of ``spec``, trained.
        spec: the shape of the policy.
        settings: anything worth keeping; numbers, strings, and lists and dicts of them.
    """
    contents = {
        "format": _FORMAT,
        "version": _VERSION,
        "spec": asdict(spec),
        "settings": settings,
        "weights": actor.state_dict(),
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    with writing(path) as file:
        torch.save(contents, file)


def load_policy(path: Path) -> SavedPolicy:
    """Reads a policy that :func:`save_policy` wrote. Nothing in the file is run.

    Args:
        path: the file.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is another kind of file, torn, or of another version.
    """
    with path.open("rb") as file:
        try:
            contents = torch.load(file, map_location="cpu", weights_only=True)
        except Exception as error:  # What is no file of torch's makes it stumble anywhere.
            raise ValueError(
                f"policy must be a file that save_policy wrote, got {str(path)!r}, which cannot "
                "be read as one."
            ) from error
    if not isinstance(contents, dict) or contents.get("format") != _FORMAT:
        raise ValueError(
            f"policy must be a file that save_policy wrote, got {str(path)!r}, which holds "
            "something else."
        )
    if contents["version"] != _VERSION:
        raise ValueError(
            f"policy must be of version {_VERSION}, got {str(path)!r} of version "
            f"{contents['version']}."
        )
    spec = ActorSpec(**contents["spec"])
    actor = make_actor(spec)
    actor.load_state_dict(contents["weights"])
    actor.requires_grad_(False)
    return SavedPolicy(actor, spec, contents["settings"])
