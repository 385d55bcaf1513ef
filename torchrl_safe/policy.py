"""A trained policy in a file of its own, and as a function of a NumPy array.

:func:`save_policy` writes any TorchRL actor that computes an action from one observation.
:func:`load_policy` needs neither the code that made the actor nor an environment, and it runs
nothing that the file holds as code.
"""

from __future__ import annotations

import copy
import io
import json
from collections.abc import Mapping
from pathlib import Path
from typing import IO, Any

import numpy as np
import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import (
    ProbabilisticTensorDictModule,
    TensorDictModule,
    TensorDictModuleBase,
)
from tensordict.utils import unravel_key
from torch import Tensor
from torchrl.data import Composite, TensorSpec
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import TanhDelta

from torchrl_safe._checks import check_kind
from torchrl_safe._files import writing
from torchrl_safe._program import Program, record

__all__ = ["Policy", "load_policy", "save_policy", "shipped_policies"]

#: The mark of our files, and the version of their contents.
_FORMAT, _VERSION = "torchrl-safe policy", 2
# The policies that come with the package, each with a card beside it that says how good it is.
_SHIPPED = Path(__file__).parent / "policies"
# Where the actor's weights are in what is recorded.
_ACTOR = "actor."


class Policy:
    """A deterministic policy: a function from observation to action, as NumPy arrays.

    :func:`load_policy` makes it. The first call takes as long as the others.

    Attributes:
        actor (TensorDictModule): the same function for ``env.rollout(policy=...)``,
            :func:`~torchrl_safe.evaluation.evaluate` and collectors.
        observation_key (NestedKey): the key that ``actor`` reads.
        action_key (NestedKey): the key that it writes.
        observation_shape (tuple of int): shape of one observation.
        action_shape (tuple of int): shape of one action.
        observation_dtype (numpy.dtype): type to which observations are converted.
        action_dtype (numpy.dtype): type of the actions.
        weights (dict): ``state_dict`` of the actor that was saved. To train it further, make the
            actor again and call ``actor.load_state_dict(policy.weights)``.
        settings (dict): what was given to :func:`save_policy`.

    Examples:
        >>> policy = load_policy("panda-reach-in-front")
        >>> policy
        Policy('observation' (40,) -> 'action' (3,))
        >>> policy(np.zeros(40)).shape, policy(np.zeros((8, 40))).shape
        ((3,), (8, 3))
    """

    def __init__(self, contents: Mapping[str, Any]) -> None:
        self.weights: dict[str, Any] = contents["weights"]
        self.settings: dict[str, Any] = contents["settings"]
        self.observation_key: NestedKey = contents["observation_key"]
        self.action_key: NestedKey = contents["action_key"]
        self.observation_shape = tuple(contents["observation_shape"])
        example = torch.zeros(1, *self.observation_shape, dtype=contents["observation_dtype"])
        self.observation_dtype = example.numpy().dtype
        tensors = {_ACTOR + name: weight for name, weight in self.weights.items()}
        program = Program(contents["steps"], {**tensors, **contents["constants"]})
        function = _AnyBatch(program, self.observation_shape, example.dtype)
        self.actor = TensorDictModule(function, [self.observation_key], [self.action_key])
        with torch.no_grad():
            action = function(example)
        if not isinstance(action, Tensor) or len(action) != 1:
            raise ValueError(f"the policy must give one action for each observation, got {action}.")
        self.action_shape = tuple(action.shape[1:])
        self.action_dtype = action.numpy().dtype
        # PyTorch does some work in the first call: do it here, not at a robot's first deadline.
        for observation in (example[0], example, example.expand(2, *self.observation_shape)):
            self(observation.numpy())

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Returns the action for an observation.

        Args:
            observation (np.ndarray): one observation, shape ``observation_shape``, or a batch of
                them, shape ``(B, *observation_shape)``.

        Returns:
            The action, shape ``action_shape`` or ``(B, *action_shape)``.

        Raises:
            TypeError: if it is given a TensorDict.
            ValueError: if the observation has another shape, cannot be converted to
                ``observation_dtype``, or holds a NaN or an infinity.
        """
        if isinstance(observation, TensorDictBase):
            raise TypeError(
                "observation must be an array, got a TensorDict: rollouts, collectors and evaluate "
                "take policy.actor."
            )
        given = np.asarray(observation)
        # Whole numbers may fit in a smaller type; where a type holds all of them, they do.
        whole = given.dtype.kind in "iu" and self.observation_dtype.kind in "iu"
        narrowed = whole and not np.can_cast(given.dtype, self.observation_dtype)
        if not narrowed and not np.can_cast(given.dtype, self.observation_dtype, "same_kind"):
            raise ValueError(
                f"observation must have dtype {self.observation_dtype}, got {given.dtype}."
            )
        batched = given.ndim > len(self.observation_shape)
        if given.shape[batched:] != self.observation_shape:
            shape = ", ".join(map(str, self.observation_shape))
            raise ValueError(
                f"observation must have shape ({shape},) or (B, {shape}), got {given.shape}."
            )
        with np.errstate(over="ignore"):  # What is too large becomes infinite.
            converted = given.astype(self.observation_dtype)
        if narrowed and not (converted == given).all():
            raise ValueError(f"observation must be in the range of {converted.dtype}, got {given}.")
        if not np.isfinite(converted).all():
            raise ValueError(f"observation must be finite in {converted.dtype}, got {given}.")
        rows = torch.from_numpy(converted)
        with torch.no_grad():
            # A copy, so that nobody can change an action that is a constant.
            return np.array(self.actor.module(rows).numpy())

    def __repr__(self) -> str:
        return (
            f"Policy({self.observation_key!r} {self.observation_shape} -> "
            f"{self.action_key!r} {self.action_shape})"
        )


def save_policy(
    path: str | Path,
    actor: TensorDictModuleBase,
    observation_spec: TensorSpec,
    *,
    action_key: NestedKey = "action",
    settings: Mapping[str, Any] | None = None,
) -> None:
    """Writes a policy to a file: its weights, and how it computes the action.

    The file holds the deterministic policy, in evaluation mode. :func:`torch.export.export` records
    it, so that :func:`load_policy` needs no code of yours, whatever networks and distributions the
    actor is made of. Transforms of the environment are not part of the actor: to save a
    normalization with it, put it in front, ``TensorDictSequential(normalization.clone(), actor)``
    (without ``clone``, a transform brings its environment along). Of a
    :class:`~torchrl.envs.VecNormV2`, put ``to_observation_norm()`` there, and make it with
    ``reduce_batch_dims=True``: by default each of several environments has its own statistics.

    The file is written all at once. If saving fails, the file that was there stays.

    Args:
        path (str or Path): the file.
        actor (TensorDictModuleBase): reads one observation and writes an action, for example a
            :class:`~torchrl.modules.ProbabilisticActor`.
        observation_spec (TensorSpec): spec of one observation, without batch dimensions:
            ``env.observation_spec_unbatched``.

    Keyword Args:
        action_key (NestedKey, optional): key of the action. Defaults to ``"action"``.
        settings (Mapping[str, Any], optional): anything worth keeping, such as the hyperparameters:
            numbers, strings, and lists and dicts of them. Defaults to nothing.

    Raises:
        TypeError: if ``path``, ``actor`` or ``observation_spec`` is not of its kind.
        ValueError: if the actor cannot be saved. It comes from :func:`load_policy`: copy the file
            instead. It reads several keys (a recurrent actor reads its state) or writes no action.
            An action depends on the observations of other rows.
            It cannot be copied, called or recorded: Python code in it must not decide by the
            values of a tensor, as that of :class:`~torchrl.modules.TruncatedNormal` does.

    Examples:
        >>> import tempfile
        >>> import numpy as np
        >>> from torchrl.data import Composite, Unbounded
        >>> from torchrl.modules import MLP
        >>> actor = TensorDictModule(MLP(4, 2), ["observation"], ["action"])
        >>> file = Path(tempfile.mkdtemp(), "policy.pt")
        >>> save_policy(file, actor, Composite(observation=Unbounded(4)))
        >>> policy = load_policy(file)
        >>> policy
        Policy('observation' (4,) -> 'action' (2,))
        >>> policy(np.zeros(4)).shape, policy(np.zeros((3, 4))).shape
        ((2,), (3, 2))
    """
    check_kind("path", path, str | Path)
    path = Path(path)
    observation_key = _observation_key(actor)
    if isinstance(getattr(actor, "module", None), _AnyBatch):
        raise ValueError("actor comes from load_policy: copy its file instead.")
    if not isinstance(observation_spec, TensorSpec):
        raise TypeError(
            "observation_spec must be a TensorSpec, such as env.observation_spec_unbatched, got "
            f"{type(observation_spec).__name__}."
        )
    action_key = unravel_key(action_key)
    if action_key not in actor.out_keys:
        raise ValueError(
            f"action_key must be one of the actor's out_keys {actor.out_keys}, got {action_key!r}."
        )
    spec = observation_spec
    if isinstance(spec, Composite):
        if observation_key not in spec.keys(True, True):
            raise ValueError(
                f"observation_spec must have the key {observation_key!r}, which the actor reads, "
                f"got {list(spec.keys(True, True))}."
            )
        if spec.shape:
            raise ValueError(
                "observation_spec must be of one observation, got one with the batch dimensions "
                f"{tuple(spec.shape)}: pass env.observation_spec_unbatched."
            )
        spec = spec[observation_key]
    try:
        actor = copy.deepcopy(actor).cpu().eval()
    except Exception as error:  # Whatever the actor's own parts raise.
        raise ValueError(
            f"actor cannot be copied: {error}. Of a transform that an environment uses, put a "
            "clone() into the actor."
        ) from error
    for module in actor.modules():
        is_last = isinstance(module, ProbabilisticTensorDictModule)
        if is_last and module.distribution_class is TanhDelta:  # Else it refuses to be recorded.
            module.distribution_kwargs = {**module.distribution_kwargs, "safe": False}
    weights = {name: _own(value) for name, value in actor.state_dict().items()}
    function = _Deterministic(actor, observation_key, action_key)
    # Leave the caller's random numbers alone.
    with (
        torch.random.fork_rng(devices=[]),
        set_exploration_type(ExplorationType.DETERMINISTIC),
        torch.no_grad(),
    ):
        rows = spec.cpu().rand((3,))
        if rows.is_floating_point():  # TorchRL draws no number where a bound is infinite.
            rows = torch.where(rows.isfinite(), rows, torch.randn_like(rows))
        try:
            action, alone = function(rows), [function(row) for row in rows.split(1)]
        except Exception as error:
            raise ValueError(f"actor cannot be called: {error}") from error
        if not action.isfinite().all():
            raise ValueError(f"actor must give finite actions, got {action[0]}.")
        try:
            steps, tensors = record(function, rows)
        except Exception as error:  # PyTorch's tracing has errors of its own, too.
            raise ValueError(f"actor cannot be recorded: {error}") from error
    contents = {
        "format": _FORMAT,
        "version": _VERSION,
        "observation_key": observation_key,
        "action_key": action_key,
        "observation_shape": list(spec.shape),
        "observation_dtype": spec.dtype,
        "steps": steps,
        "weights": weights,
        "constants": {
            name: _own(value)
            for name, value in tensors.items()
            if name.removeprefix(_ACTOR) not in weights
        },
        "settings": dict(settings or {}),
    }
    file = io.BytesIO()
    torch.save(contents, file)
    policy = _read(file, "actor and settings must be such that the file can be read again")
    # Python code that branches on its input is recorded with one branch only.
    for seen, expected in ((rows, action), (rows[:1], alone[0])):
        again = torch.from_numpy(policy(seen.numpy()))
        if not _close(again, expected):
            raise ValueError(
                "actor must compute the action in the same way from every observation, got "
                f"{expected}, and {again} from the recorded computation."
            )
    if not _close(torch.cat(alone), action):
        raise ValueError(
            "actor must compute each action from its own observation alone, got "
            f"{torch.cat(alone)} one by one, and {action} of the same observations together."
        )
    path.parent.mkdir(parents=True, exist_ok=True)
    with writing(path) as unfinished:
        unfinished.write(file.getbuffer())


def load_policy(path: str | Path) -> Policy:
    """Reads a policy that :func:`save_policy` wrote. Nothing in the file is run as code.

    The file is read with ``torch.load(weights_only=True)``, and the computation in it can only be
    made of PyTorch's Core ATen operators. The policy runs on the CPU.

    Args:
        path (str or Path): the file, or the name of a policy that comes with the package: a task of
            the :data:`~torchrl_safe.envs.SUITE`, such as ``"panda-reach-in-front"``. A file of that
            name comes first.

    Raises:
        FileNotFoundError: if there is neither such a file nor such a policy.
        ValueError: if it is another kind of file, torn, tampered with, or of another version.

    Examples:
        In the control loop of a robot::

            policy = load_policy("policy.pt")
            while True:
                robot.send(policy(robot.observation()))

        A policy that comes with the package:

        >>> policy = load_policy("panda-reach-in-front")
        >>> policy(np.zeros(policy.observation_shape)).shape
        (3,)
    """
    chosen = Path(path)
    if not chosen.is_file():
        shipped = shipped_policies()
        if str(path) not in shipped:
            raise FileNotFoundError(
                f"path must be a file or one of {', '.join(shipped)}, got {str(path)!r}."
            )
        chosen = _SHIPPED / f"{path}.pt"
    with chosen.open("rb") as file:
        return _read(file, f"path must be a file that save_policy wrote, got {str(path)!r}")


def shipped_policies() -> dict[str, dict[str, Any]]:
    """Returns the cards of the policies that come with the package, by their names.

    A card has the ``task``, its ``cost_limits``, what episodes of the deterministic policy have
    shown (``success``, ``return``, and each cost; estimates with the ends of their 95 % confidence
    intervals, but for ``worst/``, the mean of the worst tenth), and how it was ``trained``.

    Examples:
        >>> card = shipped_policies()["panda-reach-in-front"]
        >>> card["task"], card["cost_limits"]
        ('panda-reach-in-front', {'collision': 0.5})
        >>> mean, low, high = card["cost/collision"]
        >>> low <= mean <= high
        True
    """
    files = sorted(_SHIPPED.glob("*.json"))
    return {file.stem: json.loads(file.read_text(encoding="utf-8")) for file in files}


def _read(file: IO[bytes], wanted: str) -> Policy:
    file.seek(0)
    try:
        contents = torch.load(file, map_location="cpu", weights_only=True)
    except Exception as error:  # A file that is not PyTorch's can raise any error.
        raise ValueError(f"{wanted}: {error}") from error
    if not isinstance(contents, dict) or contents.get("format") != _FORMAT:
        raise ValueError(f"{wanted}: it holds something else.")
    if contents.get("version") != _VERSION:
        raise ValueError(
            f"{wanted}: it is of version {contents.get('version')}, not {_VERSION}. Save it again."
        )
    try:
        return Policy(contents)
    except Exception as error:  # A file that was tampered with, likewise.
        raise ValueError(f"{wanted}: {error}") from error


def _observation_key(actor: TensorDictModuleBase) -> NestedKey:
    if not isinstance(actor, TensorDictModuleBase):
        raise TypeError(f"actor must be a TensorDictModuleBase, got {actor!r}.")
    if len(actor.in_keys) != 1:
        raise ValueError(
            "actor must read one key, the observation, and keep no state from step to step, got "
            f"in_keys {actor.in_keys}."
        )
    return unravel_key(actor.in_keys[0])


def _own(value: Any) -> Any:
    # A clone: of a view, the file would hold all that it is a view of.
    return value.detach().clone() if isinstance(value, Tensor) else value


def _close(one: Tensor, other: Tensor) -> bool:
    return torch.allclose(one.double(), other.double(), rtol=1e-4, atol=1e-5)


class _Deterministic(torch.nn.Module):
    """The actor as a function of a tensor."""

    def __init__(
        self, actor: TensorDictModuleBase, observation_key: NestedKey, action_key: NestedKey
    ) -> None:
        super().__init__()
        self.actor = actor  # The name in _ACTOR.
        self._keys = observation_key, action_key

    def forward(self, rows: Tensor) -> Tensor:
        observation_key, action_key = self._keys
        tensordict = TensorDict({}, batch_size=rows.shape[:1]).set(observation_key, rows)
        return self.actor(tensordict).get(action_key)


class _AnyBatch(torch.nn.Module):
    """A program for rows as one for any number of batch dimensions, on any device."""

    def __init__(self, program: Program, shape: tuple[int, ...], dtype: torch.dtype) -> None:
        super().__init__()
        self.program, self.shape, self.dtype = program, shape, dtype

    def forward(self, observation: Tensor) -> Tensor:
        dims = max(0, observation.dim() - len(self.shape))
        batch, given = observation.shape[:dims], tuple(observation.shape[dims:])
        if given != self.shape:
            raise ValueError(f"observation must end in shape {self.shape}, got {given}.")
        if not torch.can_cast(observation.dtype, self.dtype):
            raise ValueError(f"observation must have dtype {self.dtype}, got {observation.dtype}.")
        rows = observation.reshape((batch.numel(), *self.shape))
        converted = rows.to("cpu", self.dtype)
        narrowed = torch.promote_types(rows.dtype, self.dtype) != self.dtype
        if narrowed and not self.dtype.is_floating_point and (converted != rows.cpu()).any():
            raise ValueError(
                f"observation must be in the range of {self.dtype}, got {observation}."
            )
        action = self.program(converted)
        return action.reshape((*batch, *action.shape[1:])).to(observation.device)
