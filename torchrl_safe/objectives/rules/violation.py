"""How far the costs are from their limits, for the losses that read it themselves."""

from __future__ import annotations

from torch import Tensor

from torchrl_safe.objectives.rules.cost_updater import CostUpdater


class ViolationUpdater(CostUpdater):
    """Tells a loss how far the batch's mean episode costs are from their limits.

    It writes the ``cost_violation`` buffer that :class:`~torchrl_safe.objectives.P3OLoss`,
    :class:`~torchrl_safe.objectives.IPOLoss`, :class:`~torchrl_safe.objectives.CRPOLoss` and, for
    CPO and PCPO, :class:`~torchrl_safe.objectives.TrustRegionLoss` read, once for each collected
    batch and before the batch is learned from. Until the first
    episode has ended the buffer is zero, as if every cost were at its limit.

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
