"""How far the costs are from their limits, for the losses that read it themselves."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor

from torchrl_safe.objectives._checks import check_number
from torchrl_safe.objectives._cost_critic import CostCriticMixin, report_each
from torchrl_safe.objectives._cost_updater import CostUpdater


class ViolationUpdater(CostUpdater):
    """Tells a loss how far the batch's mean episode costs are from their limits.

    It writes the ``cost_violation`` buffer that :class:`~torchrl_safe.objectives.P3OLoss`,
    :class:`~torchrl_safe.objectives.IPOLoss`, :class:`~torchrl_safe.objectives.CRPOLoss` and, for
    CPO and PCPO, :class:`~torchrl_safe.objectives.TrustRegionLoss` read, once for each collected
    batch and before the batch is learned from. Until the first
    episode has ended the buffer is zero: as if every cost stood at its limit.

    Args:
        loss_module (LossModule): a loss with a ``cost_violation`` buffer of shape ``(k,)``.

    Keyword Args:
        cost_limit (float, Tensor or Mapping): limit of each expected episode cost, one number,
            k, or one for each of ``cost_names``, in the unit of the undiscounted episode cost.
        pessimism (float, optional): standard errors of the batch's mean episode cost that are
            added to it, as of :class:`~torchrl_safe.objectives.MultiplierUpdater`. Defaults to
            ``0.0``.
        cost_names (sequence of str, optional): names of the k costs, as of
            :class:`~torchrl_safe.objectives.MultiplierUpdater`.

    Raises:
        ValueError: if the loss has no such buffer, or the limit or pessimism is not usable.

    Examples:
        >>> import torch
        >>> from torchrl.objectives import LossModule
        >>> loss = LossModule()
        >>> loss.register_buffer("cost_violation", torch.zeros(2))
        >>> updater = ViolationUpdater(loss, cost_limit=torch.tensor([1.0, 5.0]))
        >>> updater.step(torch.tensor([[2.0, 0.0], [4.0, 1.0]]))
        >>> loss.cost_violation
        tensor([ 2.0000, -4.5000])
    """

    buffer_name = "cost_violation"

    def _move(self, buffer: Tensor, episode_cost: Tensor) -> None:
        buffer.copy_(self._violation(episode_cost))


def check_episode_length(episode_length: float | None) -> float | None:
    """Returns the value; raises ValueError unless it is positive or None."""
    if episode_length is None:
        return None
    return check_number("episode_length", episode_length, positive=True)


def check_length_known(episode_length: float | None, gamma: Tensor) -> None:
    """Raises ValueError if neither the option nor the discount tells the length of an episode."""
    if episode_length is None and not gamma < 1:
        raise ValueError(
            "episode_length must be given if gamma of the costs is 1 or more, got None and gamma "
            f"{gamma.item()}."
        )


def per_step(episode_length: float | None, gamma: Tensor) -> Tensor | float:
    r"""What turns an amount per episode into one per step, the unit of a surrogate.

    A surrogate is a mean over steps, a violation one over whole episodes. The papers take
    :math:`1 - \gamma`, as if every episode had :math:`1 / (1 - \gamma)` steps: one of 40 steps,
    discounted by 0.99, is then taken for one of 100, and a change of the policy for 2.5 times the
    change of its cost.

    Args:
        episode_length (float, optional): mean number of steps of an episode; if ``None``,
            :math:`1 / (1 - \gamma)`.
        gamma (Tensor): discount of the costs.

    Returns:
        The share of one step in an episode.
    """
    return 1 - gamma if episode_length is None else 1 / episode_length


class ViolationMixin(CostCriticMixin):
    """Adds the buffer that :class:`ViolationUpdater` writes, and reports it."""

    cost_violation: Tensor

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        violation = torch.zeros(self.num_costs, device=self.cost_critic_coeff.device)
        self.register_buffer("cost_violation", violation)

    def _set_cost_outputs(self, losses: TensorDictBase, tensordict: TensorDictBase) -> None:
        super()._set_cost_outputs(losses, tensordict)
        report_each(losses, "cost_violation", self.cost_violation)

    def _cost_out_keys(self) -> list[NestedKey]:
        return [
            *super()._cost_out_keys(),
            *(f"cost_violation_{index}" for index in range(self.num_costs)),
        ]
