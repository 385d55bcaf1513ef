"""First order constrained optimization in policy space."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.objectives import PPOLoss

from torchrl_safe.objectives._checks import SMALLEST, as_scalar, check_number
from torchrl_safe.objectives._reduction import reduced
from torchrl_safe.objectives.functional import penalized_advantage
from torchrl_safe.objectives.on_policy.constrained import ConstrainedPPO
from torchrl_safe.objectives.on_policy.policies import divergence


class FOCOPSLoss(ConstrainedPPO, PPOLoss):
    r"""Projects the best policy of a trust region on the policies of the network.

    Presented in "First Order Constrained Optimization in Policy Space", Zhang, Vuong, Ross 2020
    (https://arxiv.org/abs/2002.06506), whose loss is the mean over the states of

    .. math::
        \left(D_{KL}(\pi_\theta \| \pi_{\theta_k}) - \frac{1}{\lambda} \,
            r \, \Big(A_r - \sum_i \nu_i A_{c_i}\Big)\right)
        \mathbb{1}\left[D_{KL}(\pi_\theta \| \pi_{\theta_k}) \le \delta\right]

    Its two terms are reported apart, ``"loss_kl"`` and ``"loss_objective"``. The multipliers
    :math:`\nu` are the ``lagrange_multiplier`` buffer, of shape ``(k,)``: a
    :class:`~torchrl_safe.objectives.MultiplierUpdater` moves them, the paper's being
    :class:`~torchrl_safe.objectives.DualAscent`. As in the paper, nothing is divided by
    :math:`1 + \sum_i \nu_i` (OmniSafe divides).

    The divergence is that from the parameters of the distribution that the collector stored, as in
    :class:`~torchrl.objectives.KLPENPPOLoss`; the distribution must be one for which
    :func:`torch.distributions.kl_divergence` is known. The paper also stops the epochs of a batch
    when the mean divergence exceeds :math:`\delta`; use the output ``"kl"`` for that.

    Args:
        actor_network (ProbabilisticTensorDictSequential): policy operator.
        critic_network (TensorDictModule): value operator of the reward, writes
            ``"state_value"`` of shape ``(*B, 1)``.
        cost_critic_network (TensorDictModule): value operator of the costs, writes
            ``"cost_value"`` of shape ``(*B, k)``.

    Keyword Args:
        num_costs (int, optional): number k of costs. Defaults to ``1``.
        temperature (float, optional): the paper's :math:`\lambda`. Defaults to ``1.5``, as
            there.
        kl_bound (float, optional): the paper's :math:`\delta`: states that have moved further
            are left out. Defaults to ``0.02``, as there.
        multiplier_init (float or Tensor, optional): multiplier to start with, one number or k.
            Defaults to ``0.0``.
        cost_critic_coeff (float, optional): weight of the cost critic's loss.
            Defaults to ``1.0``.
        normalize_cost_advantage (bool, optional): divide the cost advantages by their standard
            deviation, as :func:`~torchrl_safe.objectives.scaled_advantages` says, so that a
            multiplier has no unit. Defaults to ``True``.
        **kwargs: every keyword argument of :class:`~torchrl.objectives.PPOLoss`.

    Raises:
        TypeError: if an argument is unknown.
        ValueError: if ``num_costs``, ``temperature``, ``kl_bound`` or ``multiplier_init`` is not
            usable; in a call, if the cost critic or the costs have another width than
            ``num_costs``.
        KeyError: in a call, if the batch has no parameters of the distribution.

    Keys beside those of ``PPOLoss``, all of shape ``(*B, k)``: ``cost`` (read under
    ``"next"``), ``cost_value``, ``cost_advantage``, ``cost_value_target``.

    Outputs beside those of ``PPOLoss``: ``loss_kl``, ``kl`` (mean over the states),
    ``loss_cost_critic``, ``cost_explained_variance`` (mean over the costs),
    ``lagrange_multiplier_0`` ... ``lagrange_multiplier_{k-1}``, and with ``clip_value`` also
    ``cost_value_clip_fraction``.

    Examples:
        >>> import torch
        >>> from torchrl_safe.objectives import DualAscent
        >>> from torchrl_safe.testing import make_batch, make_networks
        >>> loss = FOCOPSLoss(*make_networks(num_costs=2), num_costs=2)
        >>> updater = DualAscent(loss, cost_limit=torch.tensor([1.0, 5.0]), lr=0.01)
        >>> updater.step(torch.tensor([[2.0, 0.0], [4.0, 1.0]]))  # a row for each episode
        >>> losses = loss(loss.estimate_advantages(make_batch(num_costs=2)).reshape(-1))
        >>> losses["lagrange_multiplier_0"], losses["kl"] > 0
        (tensor(0.0200), tensor(True))
    """

    _schedulable_buffers = frozenset({"temperature", "kl_bound"})

    policy_out_keys = ("loss_kl", "kl")

    temperature: Tensor
    kl_bound: Tensor

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        critic_network: TensorDictModuleBase,
        cost_critic_network: TensorDictModuleBase,
        *,
        num_costs: int = 1,
        temperature: float = 1.5,
        kl_bound: float = 0.02,
        multiplier_init: float | Tensor = 0.0,
        cost_critic_coeff: float = 1.0,
        **kwargs: Any,
    ) -> None:
        super().__init__(
            actor_network,
            critic_network,
            cost_critic_network,
            num_costs=num_costs,
            multiplier_init=multiplier_init,
            cost_critic_coeff=cost_critic_coeff,
            **kwargs,
        )
        temperature = check_number("temperature", temperature, SMALLEST)
        if not as_scalar(kl_bound) > 0:
            raise ValueError(f"kl_bound must be positive, got {kl_bound!r}.")
        device = self.cost_critic_coeff.device
        self.register_coeff_buffer("temperature", temperature, device=device)
        self.register_coeff_buffer("kl_bound", float(kl_bound), device=device)

    def policy_losses(
        self, tensordict: TensorDictBase, advantage: Tensor, cost_advantage: Tensor
    ) -> TensorDictBase:
        # pi_theta_k, read before the policy is evaluated, which writes parameters of its own.
        old = self.actor_network.build_dist_from_params(
            tensordict.select(*self._distribution_keys())
        )
        shape = cost_advantage.shape[:-1]
        policy = self.evaluate(tensordict).joint(shape)
        # D_KL(pi_theta || pi_theta_k)
        kl = divergence(policy.distribution, old, shape)
        far = kl > self.kl_bound
        # A_r - sum_i nu_i A_ci
        gain = penalized_advantage(
            advantage, cost_advantage, self.lagrange_multiplier, rescale=False
        )
        # A ratio of zero leaves a state out of the objective and of its gradient.
        near = policy._replace(log_ratio=policy.log_ratio.masked_fill(far, -torch.inf))
        losses = self.unconstrained(tensordict, gain / self.temperature, near)
        near_kl = reduced(self, kl.masked_fill(far, 0.0), tensordict)
        losses.set("loss_kl", near_kl.squeeze(-1))
        losses.set("kl", reduced(self, kl.detach(), tensordict, reduction="mean"))
        return losses

    def _distribution_keys(self) -> list[NestedKey]:
        return self.actor_network[-1].in_keys

    def _own_in_keys(self) -> list[NestedKey]:
        return [*super()._own_in_keys(), *self._distribution_keys()]
