"""Checks the costs of the episodes, for all updaters."""

from __future__ import annotations

import abc
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor
from torchrl.objectives import LossModule

from torchrl_safe._checks import as_tensor, check_names, check_one_each
from torchrl_safe.objectives._checks import Checked, as_scalar, check_number, uncompiled

#: Which updaters write which buffer of a loss.
_UPDATERS = {
    "lagrange_multiplier": "PIDControl or DualAscent",
    "cost_violation": "ViolationUpdater",
}


class CostUpdater(abc.ABC):
    """Checks episode costs, and lets :meth:`_move` write one buffer of a loss in place.

    Args:
        loss_module (LossModule): a loss with the buffer named ``buffer_name``, of shape ``(k,)``.

    Keyword Args:
        cost_limit (float, Tensor or Mapping): limit of each expected episode cost, one number, k,
            or one for each of ``cost_names``.
        pessimism (float, optional): standard errors of the mean that are added to it.
        cost_names (sequence of str, optional): names of the k costs in their order, for example
            ``env.cost_names``, for errors and logs. Defaults to ``("0", "1", ...)``.
    """

    buffer_name: str

    pessimism = Checked(check_number)

    def __init__(
        self,
        loss_module: LossModule,
        *,
        cost_limit: float | Tensor | Mapping[str, float],
        pessimism: float = 0.0,
        cost_names: Sequence[str] | None = None,
    ) -> None:
        loss_module = uncompiled(loss_module)
        if not isinstance(loss_module, LossModule):
            raise ValueError(f"loss_module must be a LossModule, got {type(loss_module)}.")
        buffers = dict(loss_module.named_buffers(recurse=False))
        buffer = buffers.get(self.buffer_name)
        if buffer is None:
            hints = [f" Use {_UPDATERS[name]}." for name in _UPDATERS if name in buffers]
            raise ValueError(
                f"{type(loss_module).__name__} has no {self.buffer_name} buffer.{''.join(hints)}"
            )
        self.loss_module = loss_module
        self.cost_names = check_names(cost_names, len(buffer))
        self._has_names = cost_names is not None
        self.cost_limit = cost_limit
        self.pessimism = pessimism

    @property
    def cost_limit(self) -> Tensor:
        """A copy of the limits, shape ``(k,)``, where the loss is.

        You can set what the constructor takes, all limits at once.
        """
        return self._cost_limit.to(getattr(self.loss_module, self.buffer_name), copy=True)

    @cost_limit.setter
    def cost_limit(self, cost_limit: float | Tensor | Mapping[str, float]) -> None:
        self._cost_limit = self._as_limit(cost_limit)

    def _as_limit(self, cost_limit: float | Tensor | Mapping[str, float]) -> Tensor:
        """The limits, shape ``(k,)``, or an error that says why they cannot be used."""
        buffer = getattr(self.loss_module, self.buffer_name)
        numbers: Any = cost_limit
        if isinstance(cost_limit, Mapping):
            numbers = _in_order(cost_limit, self.cost_names if self._has_names else None)
        limit = as_tensor("cost_limit", numbers, buffer.dtype)
        check_one_each("cost_limit", limit, len(buffer))
        if not limit.isfinite().all():
            raise ValueError(f"cost_limit must be finite, got {cost_limit}.")
        return limit.expand_as(buffer).clone()

    @torch.no_grad()
    def step(self, episode_cost: Tensor) -> None:
        """Moves the buffer of the loss once.

        Args:
            episode_cost (Tensor): undiscounted cost of each episode that ended in the batch,
                shape ``(E, k)``. With ``E = 0`` nothing changes.

        Raises:
            TypeError: if it is no tensor of numbers, or multipliers are in half precision.
            ValueError: if the shape is wrong or a cost is NaN or infinite. Nothing has changed
                then.

        With :class:`~torchrl.envs.RewardSum` a collector's batch gives it as
        ``batch["next", "episode_cost"][batch["next", "done"].squeeze(-1)]``. Leave the collector's
        ``set_truncated`` off: parts of episodes would count as whole ones. Do not leave the mask
        out: with one environment the shape is right too, and each step would count as an episode.
        """
        buffer = getattr(self.loss_module, self.buffer_name)
        if not isinstance(episode_cost, Tensor):
            raise TypeError(f"episode_cost must be a tensor, got {episode_cost!r}.")
        if episode_cost.dtype == torch.bool:
            raise TypeError(
                f"episode_cost must be numbers, got {episode_cost.dtype}: make the environment's "
                "cost a float, a sum of flags is a flag."
            )
        if episode_cost.ndim != 2 or episode_cost.shape[-1:] != buffer.shape:
            names = f" ({', '.join(self.cost_names)})" if self._has_names else ""
            raise ValueError(
                f"episode_cost must have shape (E, {len(buffer)}), a row for each episode that "
                f"ended and a column for each cost{names}, got {tuple(episode_cost.shape)}. With a "
                'collector: batch["next", "episode_cost"][batch["next", "done"].squeeze(-1)].'
            )
        if not (usable := episode_cost.isfinite().all(0)).all():
            raise ValueError(
                f"episode_cost must be finite, got {episode_cost[:, ~usable]} for cost "
                f"{self._names_of(~usable)}."
            )
        if not len(episode_cost):
            return
        self._move(buffer, episode_cost.to(buffer))

    @abc.abstractmethod
    def _move(self, buffer: Tensor, episode_cost: Tensor) -> None:
        """Writes the buffer in place, or raises before anything has changed."""

    def _violation(self, episode_cost: Tensor) -> Tensor:
        """How far the costs are above their limits, shape ``(k,)``."""
        cost = episode_cost.mean(0)
        if len(episode_cost) > 1:  # One alone has no standard error.
            cost = cost + self.pessimism * episode_cost.std(0) / len(episode_cost) ** 0.5
        violation = cost - self.cost_limit
        if not (usable := violation.isfinite()).all():
            raise ValueError(
                f"episode_cost must have a mean and deviation within {violation.dtype}, got "
                f"{episode_cost[:, ~usable]} for cost {self._names_of(~usable)}."
            )
        return violation

    def _names_of(self, chosen: Tensor) -> str:
        pairs = zip(self.cost_names, chosen.tolist(), strict=True)
        return ", ".join(name for name, is_chosen in pairs if is_chosen)

    def state_dict(self) -> dict[str, Any]:
        """Returns the state of the updater; the buffer is in the state of the loss."""
        return {
            "cost_limit": self.cost_limit,
            "pessimism": self.pessimism,
            "cost_names": list(self.cost_names) if self._has_names else None,
        }

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Loads a state that :meth:`state_dict` returned, with its limits and options.

        Like torch's optimizers it replaces those that this updater was made with. To continue with
        another limit, set ``cost_limit`` afterwards.

        Raises:
            ValueError: if the state is of another kind of updater, another number of costs, or
                costs of other names or in another order.
        """
        self._check_state(state_dict)
        self._cost_limit = state_dict["cost_limit"].clone()
        self.pessimism = state_dict["pessimism"]

    def _check_state(self, state_dict: dict[str, Any]) -> None:
        """Raises before anything of the state is loaded."""
        if state_dict.keys() != (own := self.state_dict().keys()):
            raise ValueError(
                f"The state of a {type(self).__name__} has {sorted(own)}, got {sorted(state_dict)}."
            )
        if state_dict["cost_limit"].shape != self.cost_limit.shape:
            raise ValueError(
                f"The state has {len(state_dict['cost_limit'])} cost limits, this updater "
                f"{len(self.cost_limit)}."
            )
        names = state_dict["cost_names"]
        if self._has_names and names is not None and tuple(names) != self.cost_names:
            raise ValueError(f"The state has the costs {names}, this updater {self.cost_names}.")


def _in_order(cost_limit: Mapping[str, float], names: tuple[str, ...] | None) -> list[float]:
    """The limits in the order of the names; what is no number becomes NaN."""
    if names is None:
        raise ValueError(
            "cost_names must give the costs in their order, for example env.cost_names, where "
            f"cost_limit goes by name, got None and {cost_limit!r}."
        )
    missing, unknown = [n for n in names if n not in cost_limit], [*set(cost_limit) - set(names)]
    if missing or unknown:
        raise ValueError(
            f"cost_limit must have a limit for each of cost_names {names}, got {cost_limit!r}: "
            f"missing {missing}, unknown {sorted(map(str, unknown))}."
        )
    return [as_scalar(cost_limit[name]) for name in names]
