"""PPO with Lagrange multipliers for the costs."""

from __future__ import annotations

from torchrl.objectives import ClipPPOLoss

from torchrl_safe.objectives.on_policy.constrained import ConstrainedPPO


class PPOLagrangianLoss(ConstrainedPPO, ClipPPOLoss):
    r"""Clipped PPO loss under constraints on k expected costs.

    Presented in "Benchmarking Safe Exploration in Deep Reinforcement Learning", Ray, Achiam,
    Amodei 2019. The clipped surrogate of PPO is maximized on the mixed advantage

    .. math::
        A = \frac{A_r - \sum_i \lambda_i A_{c_i}}{1 + \sum_i \lambda_i}

    This class is a thin specialization of :class:`~torchrl.objectives.ClipPPOLoss`, whose
    arguments, keys and outputs it keeps; with every multiplier at zero its outputs and
    gradients are those of ``ClipPPOLoss``, bit for bit. The differences are:

    - a second critic predicts the k costs; its loss is ``"loss_cost_critic"``;
    - ``lagrange_multiplier`` is a buffer of shape ``(k,)``. No optimizer and no forward changes
      it: a :class:`~torchrl_safe.objectives.MultiplierUpdater` does, in place, once for each
      collected batch;
    - :meth:`estimate_advantages` computes both advantages for a whole batch. Call it before
      the batch is cut into minibatches, so that a multiplier means the same in each of them. (A
      call of the loss with a batch that has no advantages does the same first: the reward
      advantage is standardized, which that of ``ClipPPOLoss`` is not.)

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
        **kwargs: every keyword argument of :class:`~torchrl.objectives.ClipPPOLoss`.

    Raises:
        TypeError: if an argument is unknown.
        ValueError: if ``num_costs`` or ``multiplier_init`` is not usable; in a call, if the cost
            critic or the costs have another width than ``num_costs``.

    Keys beside those of ``ClipPPOLoss``, all of shape ``(*B, k)``: ``cost`` (read under
    ``"next"``), ``cost_value``, ``cost_advantage``, ``cost_value_target``.

    Outputs beside those of ``ClipPPOLoss``: ``loss_cost_critic``, ``cost_explained_variance``
    (mean over the costs) and ``lagrange_multiplier_0`` ... ``lagrange_multiplier_{k-1}``, and
    with ``clip_value`` also ``cost_value_clip_fraction``.

    Examples:
        >>> import torch
        >>> from torchrl_safe.objectives import DualAscent
        >>> from torchrl_safe.testing import make_batch, make_networks
        >>> actor, critic, cost_critic = make_networks(num_costs=2)
        >>> loss = PPOLagrangianLoss(actor, critic, cost_critic, num_costs=2, entropy_bonus=False)
        >>> updater = DualAscent(loss, cost_limit=torch.tensor([1.0, 5.0]), lr=0.01)
        >>> updater.step(torch.tensor([[2.0, 0.0], [4.0, 1.0]]))  # a row for each episode
        >>> losses = loss(loss.estimate_advantages(make_batch(num_costs=2)).reshape(-1))
        >>> sorted(key for key in losses.keys() if key.startswith("loss_"))
        ['loss_cost_critic', 'loss_critic', 'loss_objective']
        >>> losses["lagrange_multiplier_0"]
        tensor(0.0200)
    """
