"""The surrogates that trust-region methods with costs work on."""

from __future__ import annotations

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.modules import set_recurrent_mode
from torchrl.objectives import PPOLoss

from torchrl_safe.objectives._checks import get_or_raise
from torchrl_safe.objectives._reduction import reduced
from torchrl_safe.objectives.on_policy.constrained import ConstrainedPPO


class TrustRegionLoss(ConstrainedPPO, PPOLoss):
    r"""Unclipped surrogates of the reward and of k costs, for TRPO-Lagrangian, CPO and PCPO.

    With the ratio :math:`w = \pi_\theta(a|s) / \pi_{\theta_k}(a|s)`, ``"loss_objective"`` is
    :math:`-\mathrm{E}[w A]` for the mixed advantage

    .. math::
        A = \frac{A_r - \sum_i \lambda_i A_{c_i}}{1 + \sum_i \lambda_i}

    (Schulman et al. 2015, https://arxiv.org/abs/1502.05477, equation 14; Achiam et al. 2017,
    https://arxiv.org/abs/1705.10528, equation 10), and :meth:`cost_surrogate_loss` gives
    :math:`\mathrm{E}[w A_{c_i}]`. The loss does not bound the policy's step. A
    :class:`~torchrl_safe.objectives.TrustRegionStep` moves the actor, and an ordinary optimizer
    moves the two critics with :meth:`critic_losses`. (TRPO without costs needs only
    :class:`~torchrl.objectives.PPOLoss`.)

    This class is a thin specialization of :class:`~torchrl.objectives.PPOLoss`, whose arguments,
    keys and outputs it keeps; with every multiplier at zero its outputs and gradients are those
    of ``PPOLoss``, bit for bit. The differences are those of
    :class:`~torchrl_safe.objectives.PPOLagrangianLoss` from ``ClipPPOLoss``: the cost critic,
    :meth:`estimate_advantages` for whole batches, and a buffer of shape ``(k,)`` that an updater
    writes once for each of them. For TRPO-Lagrangian it is ``lagrange_multiplier`` and any
    :class:`~torchrl_safe.objectives.MultiplierUpdater`; for CPO and PCPO ``cost_violation`` and
    the :class:`~torchrl_safe.objectives.ViolationUpdater`, with the multipliers left at zero.

    Args:
        actor_network (ProbabilisticTensorDictSequential): policy operator.
        critic_network (TensorDictModule): value operator of the reward, writes
            ``"state_value"`` of shape ``(*B, 1)``.
        cost_critic_network (TensorDictModule): value operator of the costs, writes
            ``"cost_value"`` of shape ``(*B, k)``.

    Keyword Args:
        num_costs (int, optional): number k of costs. Defaults to ``1``.
        multiplier_init (float or Tensor, optional): multiplier to start with, one number or k.
            Defaults to ``0.0``.
        cost_critic_coeff (float, optional): weight of the cost critic's loss.
            Defaults to ``1.0``.
        normalize_cost_advantage (bool, optional): divide the cost advantages by their standard
            deviation, as :func:`~torchrl_safe.objectives.scaled_advantages` says, so that a
            multiplier has no unit. Defaults to ``True``.
        **kwargs: every keyword argument of :class:`~torchrl.objectives.PPOLoss`. Its
            ``entropy_bonus`` is on by default; the step then maximizes it too.

    Raises:
        TypeError: if an argument is unknown.
        ValueError: if ``num_costs`` or ``multiplier_init`` is not usable; in a call, if the cost
            critic or the costs have another width than ``num_costs``.

    Keys beside those of ``PPOLoss``, all of shape ``(*B, k)``: ``cost`` (read under ``"next"``),
    ``cost_value``, ``cost_advantage``, ``cost_value_target``.

    Outputs beside those of ``PPOLoss``: ``loss_cost_critic``, ``cost_explained_variance`` (mean
    over the costs), ``lagrange_multiplier_0`` ... ``lagrange_multiplier_{k-1}``,
    ``cost_violation_0`` ... ``cost_violation_{k-1}``, and with ``clip_value`` also
    ``cost_value_clip_fraction``.

    Examples:
        >>> import torch
        >>> from torchrl_safe.objectives import CPO, TrustRegionStep, ViolationUpdater
        >>> from torchrl_safe.testing import make_batch, make_networks
        >>> loss = TrustRegionLoss(*make_networks(), entropy_bonus=False)
        >>> critics = [loss.critic_network_params, loss.cost_critic_network_params]
        >>> optimizer = torch.optim.Adam([p for params in critics for p in params.parameters()])
        >>> updater = ViolationUpdater(loss, cost_limit=1.0)
        >>> actor_step = TrustRegionStep(loss, CPO(), max_kl=0.01)
        >>> updater.step(torch.tensor([[2.0], [3.0], [1.0]]))  # a row for each episode
        >>> data = loss.estimate_advantages(make_batch()).reshape(-1)
        >>> info = actor_step.step(data)
        >>> bool(info["kl"] <= 0.01)
        True
        >>> losses = loss.critic_losses(data)
        >>> (losses["loss_critic"] + losses["loss_cost_critic"]).backward()
        >>> optimizer.step()
    """

    cost_buffers = ("lagrange_multiplier", "cost_violation")

    # Not among the outputs of forward: trainers add up everything there that is named a loss.
    def cost_surrogate_loss(self, tensordict: TensorDictBase) -> Tensor:
        """Mean of ratio times cost advantage, the first-order change of each cost per step.

        Args:
            tensordict (TensorDictBase): data with the actor's inputs, the action, its
                log-probability and ``cost_advantage``.

        Returns:
            One surrogate for each cost, shape ``(k,)``, in the unit of the cost advantages: that of
            the cost with ``normalize_cost_advantage=False``.

        Raises:
            KeyError: if there is no ``cost_advantage``.
            ValueError: if it has another width than ``num_costs``.
        """
        cost_advantage = get_or_raise(tensordict, self.tensor_keys.cost_advantage)
        self._check_width(self.tensor_keys.cost_advantage, cost_advantage)
        policy = self.evaluate(tensordict.clone(False))
        ratio = policy.joint(cost_advantage.shape[:-1]).ratio()
        surrogates = (ratio * cost_advantage).split(1, -1)
        return torch.stack([reduced(self, surrogate, tensordict) for surrogate in surrogates])

    def critic_losses(self, tensordict: TensorDictBase) -> TensorDictBase:
        """The losses of both critics, without the policy, which the step has already moved.

        Args:
            tensordict (TensorDictBase): data with the critics' inputs and value targets.

        Returns:
            ``"loss_critic"`` and ``"loss_cost_critic"``, those of a call of the loss, bit for
            bit.

        Raises:
            KeyError: if a value target is missing.
        """
        tensordict = tensordict.clone(False)
        with set_recurrent_mode(True):  # TorchRL does so where a name ends in "loss".
            tensordict.update(self.actor_features(tensordict))
            losses = {"loss_cost_critic": self.loss_cost_critic(tensordict)[0]}
            if self.critic_coeff is not None:
                losses["loss_critic"] = self.loss_critic(tensordict)[0]
        return TensorDict(
            {name: reduced(self, loss, tensordict).squeeze(-1) for name, loss in losses.items()}
        )
