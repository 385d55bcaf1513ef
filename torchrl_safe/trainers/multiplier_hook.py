"""Moves the multipliers of a loss inside a TorchRL trainer."""

from __future__ import annotations

from typing import Any

from tensordict import TensorDictBase
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor, nn
from torchrl.trainers import Trainer, TrainerHookBase

from torchrl_safe.objectives.rules.cost_updater import CostUpdater


class MultiplierHook(TrainerHookBase):
    """Steps an updater with the costs of the episodes that ended in each collected batch.

    It acts once for each batch, before the trainer learns from it, in any
    :class:`~torchrl.trainers.Trainer` whose collector yields batches: PPO's, SAC's or your own. Sum
    up the costs of an episode in the environment, with
    ``RewardSum(["reward", "cost"], ["episode_reward", "episode_cost"])``.

    Args:
        updater (MultiplierUpdater or ViolationUpdater): moves a buffer of the trainer's loss. Its
            ``cost_names`` are those of the logs.

    Keyword Args:
        episode_cost_key (NestedKey, optional): undiscounted cost of the episode so far, read
            under ``"next"``, shape ``(*B, k)``. Defaults to ``"episode_cost"``.
        done_key (NestedKey, optional): read under ``"next"``, shape ``(*B, 1)``.
            Defaults to ``"done"``.

    Raises:
        TypeError: if ``updater`` is no updater of :mod:`torchrl_safe.objectives`.
        ValueError: in :meth:`register`, if the trainer trains another loss than the updater's or
            gives no batches to its hooks, or its collector cuts episodes; in a call, if the shapes
            of cost and done do not fit, or a cost is not finite.
        KeyError: in a call, if the batch has no such key.

    Logged are, for each cost, ``"lagrange_multiplier/<name>"`` (after the step; for a
    ``ViolationUpdater`` it is ``"cost_violation/<name>"``) and ``"episode_cost/<name>"``, the mean
    over the episodes that ended, where any did.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.objectives import LossModule
        >>> from torchrl_safe.objectives import DualAscent
        >>> loss = LossModule()
        >>> loss.register_buffer("lagrange_multiplier", torch.zeros(1))
        >>> names = ["collision"]  # Of an environment: env.cost_names.
        >>> limits = {"collision": 1.0}
        >>> hook = MultiplierHook(DualAscent(loss, cost_limit=limits, cost_names=names, lr=0.5))
        >>> batch = TensorDict(
        ...     next=TensorDict(
        ...         episode_cost=torch.tensor([[2.0], [3.0], [9.0]]),
        ...         done=torch.tensor([[False], [True], [False]]),
        ...     ),
        ... ).auto_batch_size_(1)
        >>> batch = hook(batch)  # One episode ended, 2 above the limit.
        >>> hook.log(batch)["lagrange_multiplier/collision"]
        1.0
    """

    def __init__(
        self,
        updater: CostUpdater,
        *,
        episode_cost_key: NestedKey = "episode_cost",
        done_key: NestedKey = "done",
    ) -> None:
        if not isinstance(updater, CostUpdater):
            raise TypeError(
                "updater must be a MultiplierUpdater or a ViolationUpdater, got "
                f"{type(updater).__name__}."
            )
        self.updater = updater
        self.episode_cost_key = unravel_key(("next", episode_cost_key))
        self.done_key = unravel_key(("next", done_key))

    def __call__(self, batch: TensorDictBase) -> TensorDictBase:
        """Steps the updater; the batch is returned as it is."""
        self.updater.step(self._episode_cost(batch))
        return batch

    def log(self, batch: TensorDictBase | None) -> dict[str, Any]:
        """The scalars to log for a batch, one for each cost: trainers log nothing larger."""
        if batch is None:
            raise ValueError(
                "collector must yield its batches, so that the costs in them are seen: it must not "
                "have a replay_buffer of its own."
            )
        scalars = {self.updater.buffer_name: self._buffer}
        episode_cost = self._episode_cost(batch)
        if len(episode_cost):
            scalars["episode_cost"] = episode_cost.mean(0)
        return {
            "log_pbar": True,
            **{
                f"{title}/{name}": value
                for title, values in scalars.items()
                for name, value in zip(self.updater.cost_names, values.tolist(), strict=True)
            },
        }

    @property
    def _buffer(self) -> Tensor:
        return getattr(self.updater.loss_module, self.updater.buffer_name)

    def _episode_cost(self, batch: TensorDictBase) -> Tensor:
        """Cost of each episode that ended in the batch, shape ``(E, k)``."""
        done, cost = (batch.get(key, None) for key in (self.done_key, self.episode_cost_key))
        if done is None:
            raise KeyError(f"done_key {self.done_key!r} is not in the batch.")
        if cost is None:
            raise KeyError(
                f"episode_cost_key {self.episode_cost_key!r} is not in the batch: append "
                'RewardSum(["reward", "cost"], ["episode_reward", "episode_cost"]) to the '
                "environment."
            )
        if done.shape != (*cost.shape[:-1], 1):
            raise ValueError(
                f"done_key {self.done_key!r} must be of shape {(*cost.shape[:-1], 1)} where "
                f"episode_cost_key {self.episode_cost_key!r} is of shape {tuple(cost.shape)}, got "
                f"{tuple(done.shape)}."
            )
        return cost[done.squeeze(-1)]

    def state_dict(self) -> dict[str, Any]:
        """Returns the updater's state; the multiplier itself is in the state of the loss."""
        return {"updater": self.updater.state_dict()}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Loads a state that :meth:`state_dict` returned."""
        self.updater.load_state_dict(state_dict["updater"])

    def register(self, trainer: Trainer, name: str = "multiplier") -> None:
        """Registers the step, the logs and the updater's state in a trainer.

        Args:
            trainer (Trainer): the trainer of the updater's loss.
            name (str, optional): under which the state is saved. Defaults to ``"multiplier"``.
        """
        loss = trainer.loss_module
        # Found again inside a loss that was compiled or wrapped after the updater was made.
        buffers = loss.buffers() if isinstance(loss, nn.Module) else ()
        if not any(buffer is self._buffer for buffer in buffers):
            raise ValueError(
                f"updater must be of the trainer's loss_module, a {type(loss).__name__}: it moves "
                f"another {type(self.updater.loss_module).__name__}."
            )
        if trainer.async_collection:
            raise ValueError(
                "async_collection must be False: the trainer then sees no collected batch, and "
                "the multiplier would never move."
            )
        if getattr(trainer.collector, "set_truncated", False):
            raise ValueError(
                "set_truncated of the collector must be False: it cuts episodes at the end of a "
                "batch, so that they would count with a part of their cost."
            )
        if getattr(trainer.collector, "reset_at_each_iter", False):
            raise ValueError(
                "reset_at_each_iter of the collector must be False: the cost of episodes that it "
                "cuts would never count. Where batches are of whole episodes it changes nothing."
            )
        if trainer.learner_backend != "local":
            raise ValueError(
                f"learner_backend must be 'local', got {trainer.learner_backend!r}: the loss of "
                "another process would never see the multiplier move."
            )
        trainer.register_module(name, self)
        trainer.register_op("batch_process", self)
        trainer.register_op("pre_steps_log", self.log)
