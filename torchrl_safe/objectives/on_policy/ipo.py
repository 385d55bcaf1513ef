"""PPO with a logarithmic barrier before the limits of the costs."""

from __future__ import annotations

from typing import Any

import torch
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModuleBase
from torch import Tensor
from torchrl.objectives import ClipPPOLoss

from torchrl_safe.objectives._checks import SMALLEST, coefficients
from torchrl_safe.objectives.on_policy.surrogate import CostSurrogate


def log_barrier(violation: Tensor, sharpness: Tensor) -> Tensor:
    r"""Logarithmic barrier, continued by its tangent where the limit is reached.

    .. math::
        -\frac{1}{t} \log(-z) \quad \text{for} \quad z \le -\frac{1}{t^2}

    (Liu et al. 2019, https://arxiv.org/abs/1910.09615), and beyond that the line of slope
    t that continues it (Kervadec et al. 2019, https://arxiv.org/abs/1904.04205), because the
    logarithm is not defined where the limit is exceeded.

    Args:
        violation (Tensor): cost minus limit z, any shape.
        sharpness (Tensor): the parameter t; the larger, the closer to the limit it acts.

    Returns:
        The penalty, to be minimized, of the shape of ``violation``.

    Examples:
        >>> import torch
        >>> log_barrier(torch.tensor([-1.0, -0.25, 1.0]), torch.tensor(2.0))
        tensor([0.0000, 0.6931, 3.1931])
    """
    edge = -(sharpness**-2)
    inside = torch.minimum(violation, edge)
    return -(-inside).log() / sharpness + sharpness * (violation - inside)


class IPOLoss(CostSurrogate, ClipPPOLoss):
    r"""Clipped PPO loss with a logarithmic barrier before the limits of k expected costs.

    Presented in "IPO: Interior-point Policy Optimization under Constraints", Liu, Ding, Liu 2019
    (https://arxiv.org/abs/1910.09615). To the loss of PPO it adds

    .. math::
        -\frac{1 - \gamma}{t} \sum_i \log\left(d_i - J_{c_i}(\pi_\theta)\right)

    as ``"loss_penalty"``, which acts like a multiplier of :math:`1 / (t (d_i - J_{c_i}))` that
    need not be learnt. A :class:`~torchrl_safe.objectives.ViolationUpdater` brings
    :math:`J_{c_i} - d_i` of the policy that collected the batch, once for each of them; the cost
    of the policy that is being trained is estimated from it with PPO's clipped surrogate,

    .. math::
        J_{c_i}(\pi_\theta) \approx J_{c_i} + \frac{1}{1 - \gamma}
            \mathbb{E}[\max(r A_{c_i}, \mathrm{clip}(r) A_{c_i}) - A_{c_i}],

    :math:`\gamma` being the discount of the cost's value estimator. (The last term has mean zero
    over a batch. It removes the noise of minibatches, which the barrier would take for a change of
    the policy.) The factor :math:`1 - \gamma`
    before the barrier is ours: it brings the barrier, which is about episodes, to the unit of
    PPO's objective, which is about steps, so that t means the same whatever the discount.

    A barrier keeps the policy away from the limit: with one binding cost the policy settles where
    :math:`t (d - J_c)` is the inverse of the optimal multiplier. The paper requires a policy that
    starts within the limits. From outside, a tangent of the barrier leads back, like a
    multiplier of t. OmniSafe's implementation gives the collecting policy's
    :math:`1 / (t (d_i - J_{c_i}))` the place of a multiplier, and holds it fixed while the policy
    moves.

    Args:
        actor_network (ProbabilisticTensorDictSequential): policy operator.
        critic_network (TensorDictModule): value operator of the reward, writes
            ``"state_value"`` of shape ``(*B, 1)``.
        cost_critic_network (TensorDictModule): value operator of the costs, writes
            ``"cost_value"`` of shape ``(*B, k)``.

    Keyword Args:
        num_costs (int, optional): number k of costs. Defaults to ``1``.
        sharpness (float or Tensor, optional): the paper's t: the larger, the closer to the limit
            the barrier acts; one number, or one for each cost, shape ``(k,)``. Defaults to
            ``20.0``.
        episode_length (float, optional): mean number of steps of an episode, to compare a
            surrogate, which is about one step, with a violation, which is about an episode.
            Defaults to :math:`1 / (1 - \gamma)`, as in the equation above.
        cost_critic_coeff (float, optional): weight of the cost critic's loss.
            Defaults to ``1.0``.
        **kwargs: every keyword argument of :class:`~torchrl.objectives.ClipPPOLoss`.

    Raises:
        TypeError: if an argument is unknown.
        ValueError: if ``num_costs`` or ``sharpness`` is not positive, ``reduction`` is not
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
        >>> loss = IPOLoss(*make_networks(num_costs=2), num_costs=2)
        >>> updater = ViolationUpdater(loss, cost_limit=torch.tensor([1.0, 5.0]))
        >>> updater.step(torch.tensor([[2.0, 0.0], [4.0, 1.0]]))  # a row for each episode
        >>> losses = loss(loss.estimate_advantages(make_batch(num_costs=2)).reshape(-1))
        >>> losses["cost_violation_0"], losses["loss_penalty"] > 0
        (tensor(2.), tensor(True))
    """

    _schedulable_buffers = frozenset({"sharpness"})

    sharpness: Tensor

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        critic_network: TensorDictModuleBase,
        cost_critic_network: TensorDictModuleBase,
        *,
        num_costs: int = 1,
        sharpness: float | Tensor = 20.0,
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
        sharpness = coefficients("sharpness", sharpness, num_costs, SMALLEST)
        self.register_buffer("sharpness", sharpness.to(self.cost_critic_coeff.device))

    def penalty(self, surrogate: Tensor, scale: Tensor | float) -> Tensor:
        # J_c(pi_theta) - d
        violation = self.cost_violation + surrogate / scale
        # -(1 - gamma) / t log(d - J_c(pi_theta))
        return scale * log_barrier(violation, self.sharpness)
