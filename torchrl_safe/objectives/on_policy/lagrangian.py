"""Any advantage loss of TorchRL with Lagrange multipliers for the costs."""

from __future__ import annotations

from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.objectives import LossModule

from torchrl_safe.objectives.on_policy.constrained import ConstrainedLoss
from torchrl_safe.objectives.on_policy.wrapped import WrappedLoss


class LagrangianLoss(ConstrainedLoss, WrappedLoss):
    r"""Puts an advantage loss under constraints on k expected costs.

    The wrapped loss stays as it is, and gets the advantage of
    :func:`~torchrl_safe.objectives.penalized_advantage` instead of the reward's,

    .. math::
        A = \frac{A_r - \sum_i \lambda_i A_{c_i}}{1 + \sum_i \lambda_i},

    so with every multiplier at zero all its outputs and gradients are those of the wrapped loss,
    bit for bit. :class:`~torchrl.objectives.A2CLoss`,
    :class:`~torchrl.objectives.ReinforceLoss`, :class:`~torchrl.objectives.PPOLoss`,
    :class:`~torchrl.objectives.ClipPPOLoss` and :class:`~torchrl.objectives.KLPENPPOLoss` can be
    wrapped. ``lagrange_multiplier`` is a buffer of shape ``(k,)`` that a
    :class:`~torchrl_safe.objectives.MultiplierUpdater` moves, once for each collected batch.

    :class:`~torchrl_safe.objectives.PPOLagrangianLoss` is the same loss as
    ``LagrangianLoss(ClipPPOLoss(actor, critic), cost_critic)``, to the bit, written as a subclass:
    its networks are attributes of the loss itself, as trainers of ``ClipPPOLoss`` expect, and it
    takes ``normalize_advantage`` and ``advantage_norm``, which act before the mixing there and
    would act after it here.

    Args:
        loss_module (LossModule): the loss to constrain. Its ``reduction``, ``clip_value``,
            ``loss_critic_type`` and masks hold for the cost critic too.
        cost_critic_network (TensorDictModule): value operator of the costs, writes
            ``"cost_value"`` of shape ``(*B, k)``.

    Keyword Args:
        num_costs (int, optional): number k of costs. Defaults to ``1``.
        multiplier_init (float or Tensor, optional): multiplier to start with, one number or k.
            Defaults to ``0.0``.
        cost_critic_coeff (float, optional): weight of the cost critic's loss.
            Defaults to ``1.0``.
        separate_losses (bool, optional): leave parameters that the cost critic shares with the
            policy out of the cost critic's loss. ``loss_module`` must be functional. Defaults to
            ``False``.
        normalize_cost_advantage (bool, optional): divide the cost advantages by their standard
            deviation, as :func:`~torchrl_safe.objectives.scaled_advantages` says, so that a
            multiplier has no unit. Defaults to ``True``.

    Raises:
        TypeError: if ``separate_losses`` or ``normalize_cost_advantage`` is not a bool.
        ValueError: if ``loss_module`` reads no advantage, normalizes it or has no critic, or
            ``num_costs`` or ``multiplier_init`` is not usable; in a call, if the cost critic or
            the costs have another width than ``num_costs``.

    :meth:`set_keys` takes the keys of the wrapped loss, and of shape ``(*B, k)``: ``cost`` (read
    under ``"next"``), ``cost_value``, ``cost_advantage``, ``cost_value_target``.

    Outputs beside those of the wrapped loss: ``loss_cost_critic``, ``cost_explained_variance``
    (mean over the costs) and ``lagrange_multiplier_0`` ... ``lagrange_multiplier_{k-1}``, and
    with ``clip_value`` also ``cost_value_clip_fraction``.

    Examples:
        >>> import torch
        >>> from torchrl.objectives import A2CLoss
        >>> from torchrl_safe.objectives import DualAscent
        >>> from torchrl_safe.testing import make_batch, make_networks
        >>> actor, critic, cost_critic = make_networks(num_costs=2)
        >>> a2c = A2CLoss(actor, critic, entropy_bonus=False)
        >>> loss = LagrangianLoss(a2c, cost_critic, num_costs=2)
        >>> updater = DualAscent(loss, cost_limit=1.0, lr=0.5)
        >>> updater.step(torch.tensor([[3.0, 0.0]]))  # a row for each episode
        >>> loss.lagrange_multiplier
        tensor([1., 0.])
        >>> losses = loss(loss.estimate_advantages(make_batch(num_costs=2)).reshape(-1))
        >>> sorted(key for key in losses.keys() if key.startswith("loss_"))
        ['loss_cost_critic', 'loss_critic', 'loss_objective']
    """

    def __init__(
        self,
        loss_module: LossModule,
        cost_critic_network: TensorDictModuleBase,
        *,
        num_costs: int = 1,
        multiplier_init: float | Tensor = 0.0,
        cost_critic_coeff: float = 1.0,
        separate_losses: bool = False,
        normalize_cost_advantage: bool = True,
    ) -> None:
        super().__init__(
            loss_module,
            cost_critic_network=cost_critic_network,
            num_costs=num_costs,
            multiplier_init=multiplier_init,
            cost_critic_coeff=cost_critic_coeff,
            separate_losses=separate_losses,
            normalize_cost_advantage=normalize_cost_advantage,
        )
