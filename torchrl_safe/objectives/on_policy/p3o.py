"""PPO with an exact penalty on the costs."""

from __future__ import annotations

from typing import Any

from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModuleBase
from torch import Tensor
from torchrl.objectives import ClipPPOLoss

from torchrl_safe.objectives._checks import SMALLEST, coefficients
from torchrl_safe.objectives.on_policy.surrogate import CostSurrogate


class P3OLoss(CostSurrogate, ClipPPOLoss):
    r"""Clipped PPO loss with an exact penalty on k expected costs.

    Presented in "Penalized Proximal Policy Optimization for Safe Reinforcement Learning", Zhang
    et al. 2022 (https://arxiv.org/abs/2205.11814). To the loss of PPO it adds

    .. math::
        \kappa \sum_i \max\left(0,\ \mathbb{E}[\max(r A_{c_i}, \mathrm{clip}(r) A_{c_i}) - A_{c_i}]
            + (1 - \gamma) (J_{c_i} - d_i)\right)

    as ``"loss_penalty"``. There is no multiplier to learn: for a :math:`\kappa` larger than every
    optimal multiplier the penalty is exact. A :class:`~torchrl_safe.objectives.ViolationUpdater`
    brings the violations :math:`J_{c_i} - d_i`, once for each collected batch. While no limit
    binds the penalty is zero, and the loss :class:`~torchrl.objectives.ClipPPOLoss`, bit for bit.
    The term :math:`-A_{c_i}`, of mean zero over a batch, is not in the paper. Without it, the noise
    of a minibatch would look like a violation.

    :math:`\gamma` is the discount of the cost's value estimator. The factor
    :math:`1 - \gamma` turns the cost of an episode into the cost of a step, which is the unit of
    the advantages. OmniSafe's implementation leaves out the factor and the clipping; here both are
    as in the paper. For episodes of few steps T, choose a discount of about ``1 - 1 / T``, or pass
    ``episode_length``.

    Args:
        actor_network (ProbabilisticTensorDictSequential): policy operator.
        critic_network (TensorDictModule): value operator of the reward, writes
            ``"state_value"`` of shape ``(*B, 1)``.
        cost_critic_network (TensorDictModule): value operator of the costs, writes
            ``"cost_value"`` of shape ``(*B, k)``.

    Keyword Args:
        num_costs (int, optional): number k of costs. Defaults to ``1``.
        penalty_coeff (float or Tensor, optional): the factor :math:`\kappa`, in units of
            standardized reward advantage per cost advantage; one number, or one for each cost,
            shape ``(k,)``. Defaults to ``20.0``.
        episode_length (float, optional): mean number of steps of an episode, to compare a
            surrogate, which is about one step, with a violation, which is about an episode.
            Defaults to :math:`1 / (1 - \gamma)`, as in the equation above.
        cost_critic_coeff (float, optional): weight of the cost critic's loss.
            Defaults to ``1.0``.
        **kwargs: every keyword argument of :class:`~torchrl.objectives.ClipPPOLoss`.

    Raises:
        TypeError: if an argument is unknown.
        ValueError: if ``num_costs`` or ``penalty_coeff`` is not positive, ``reduction`` is not
            ``"mean"`` or the discount of the costs is 1 without an ``episode_length``; in a
            call, if the cost critic or the costs have another width than ``num_costs``.

    Keys beside those of ``ClipPPOLoss``, all of shape ``(*B, k)``: ``cost`` (read under
    ``"next"``), ``cost_value``, ``cost_advantage``, ``cost_value_target``.

    Outputs beside those of ``ClipPPOLoss``: ``loss_penalty``, ``loss_cost_critic``,
    ``cost_explained_variance`` (mean over the costs), ``cost_violation_0`` ...
    ``cost_violation_{k-1}``, and with ``clip_value`` also ``cost_value_clip_fraction``.

    Examples:
        >>> import torch
        >>> from torchrl_safe.objectives import ViolationUpdater
        >>> from torchrl_safe.testing import make_batch, make_networks
        >>> loss = P3OLoss(*make_networks(num_costs=2), num_costs=2)
        >>> updater = ViolationUpdater(loss, cost_limit=torch.tensor([1.0, 5.0]))
        >>> updater.step(torch.tensor([[2.0, 0.0], [4.0, 1.0]]))  # a row for each episode
        >>> losses = loss(loss.estimate_advantages(make_batch(num_costs=2)).reshape(-1))
        >>> losses["cost_violation_0"], losses["loss_penalty"] > 0
        (tensor(2.), tensor(True))
    """

    _schedulable_buffers = frozenset({"penalty_coeff"})

    penalty_coeff: Tensor

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        critic_network: TensorDictModuleBase,
        cost_critic_network: TensorDictModuleBase,
        *,
        num_costs: int = 1,
        penalty_coeff: float | Tensor = 20.0,
        episode_length: float | None = None,
        cost_critic_coeff: float = 1.0,
        **kwargs: Any,
    ) -> None:
        super().__init__(
            actor_network,
            critic_network,
            cost_critic_network,
            num_costs=num_costs,
            episode_length=episode_length,
            cost_critic_coeff=cost_critic_coeff,
            **kwargs,
        )
        penalty_coeff = coefficients("penalty_coeff", penalty_coeff, num_costs, SMALLEST)
        self.register_buffer("penalty_coeff", penalty_coeff.to(self.cost_critic_coeff.device))

    def penalty(self, surrogate: Tensor, scale: Tensor | float) -> Tensor:
        # kappa max(0, surrogate + (1 - gamma) (J_c - d))
        return self.penalty_coeff * (surrogate + scale * self.cost_violation).relu()
