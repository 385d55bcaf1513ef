"""Constraint-rectified policy optimization: either the reward, or one cost that is too high."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.objectives import LossModule

from torchrl_safe.objectives._checks import check_columns, check_rows, coefficients
from torchrl_safe.objectives.on_policy.constrained import ConstrainedLoss
from torchrl_safe.objectives.on_policy.wrapped import WrappedLoss


def rectified_advantage(
    advantage: Tensor,
    cost_advantage: Tensor,
    violation: Tensor,
    tolerance: Tensor | float,
    scale: Tensor | None = None,
) -> Tensor:
    r"""The reward advantage while every limit is kept, else that of lowering the worst cost.

    .. math::
        A = \begin{cases}
            A_r & \text{if } J_{c_i} \le d_i + \eta_i \text{ for all } i \\
            -A_{c_j} & \text{otherwise, with } j = \text{arg}\max_i
                (J_{c_i} - d_i - \eta_i) / s_i
        \end{cases}

    (Xu, Liang, Lan 2021, https://arxiv.org/abs/2011.05869, algorithm 1, which leaves open which
    of several violated limits j is.)

    Args:
        advantage (Tensor): reward advantage, shape ``(*B, 1)``.
        cost_advantage (Tensor): advantage of each of the k costs, shape ``(*B, k)``.
        violation (Tensor): mean episode cost minus limit, shape ``(k,)``.
        tolerance (Tensor or float): the margins :math:`\eta_i`, in the units of the episode costs,
            one number or shape ``(k,)``.
        scale (Tensor, optional): the sizes :math:`s_i` by which violations in different units
            compare, shape ``(k,)``. A cost of size 0 comes last. Defaults to 1 for each cost.

    Returns:
        The advantage to maximize, shape ``(*B, 1)``.

    Raises:
        ValueError: if the three shapes do not fit together.

    Examples:
        >>> import torch
        >>> reward, cost = torch.tensor([[1.0], [2.0]]), torch.tensor([[3.0, 4.0], [5.0, 6.0]])
        >>> rectified_advantage(reward, cost, torch.tensor([-1.0, 0.1]), tolerance=0.2)
        tensor([[1.],
                [2.]])
        >>> rectified_advantage(reward, cost, torch.tensor([-1.0, 0.3]), tolerance=0.2)
        tensor([[-4.],
                [-6.]])
    """
    check_columns(cost_advantage, "violation", violation)
    check_rows(advantage, cost_advantage)
    excess = violation - tolerance
    relative = excess
    if scale is not None:  # It is 0 for all costs until advantages are estimated.
        sizes = torch.where(scale > 0, scale, torch.inf)
        relative = torch.where((scale > 0).any(), excess / sizes, excess)
    exceeded = excess > 0
    worst = torch.where(exceeded, relative, -torch.inf).argmax().reshape(1)
    return torch.where(exceeded.any(), -cost_advantage.index_select(-1, worst), advantage)


class CRPOLoss(ConstrainedLoss, WrappedLoss):
    r"""Gives an advantage loss the reward, or the cost whose limit is exceeded most.

    Presented in "CRPO: A New Approach for Safe Reinforcement Learning with Convergence
    Guarantee", Xu, Liang, Lan 2021 (https://arxiv.org/abs/2011.05869). There is no multiplier: as
    long as every mean episode cost is within its limit and a tolerance, the loss is the wrapped
    one, bit for bit; else its advantage is that of the cost that exceeds its limit most, negated.
    With ``normalize_cost_advantage``, violations are divided by the standard deviations of the
    cost advantages before they are compared. A
    :class:`~torchrl_safe.objectives.ViolationUpdater` brings the violations, once for each
    collected batch. The cost then swings about ``cost_limit + tolerance``. (The paper returns the
    policy of a randomly chosen step that maximized the reward.)

    The paper takes natural-gradient steps on the advantage; here the wrapped loss decides:
    :class:`~torchrl.objectives.ClipPPOLoss`, :class:`~torchrl.objectives.A2CLoss` and all others
    that :class:`~torchrl_safe.objectives.LagrangianLoss` takes.

    Args:
        loss_module (LossModule): the loss to constrain. Its ``reduction``, ``clip_value``,
            ``loss_critic_type`` and masks hold for the cost critic too.
        cost_critic_network (TensorDictModule): value operator of the costs, writes
            ``"cost_value"`` of shape ``(*B, k)``.

    Keyword Args:
        num_costs (int, optional): number k of costs. Defaults to ``1``.
        tolerance (float or Tensor, optional): how far a limit may be exceeded, in the unit of the
            episode cost; one number, or one for each cost, shape ``(k,)``. Defaults to ``0.0``.
        cost_critic_coeff (float, optional): weight of the cost critic's loss.
            Defaults to ``1.0``.
        separate_losses (bool, optional): leave parameters that the cost critic shares with the
            policy out of the cost critic's loss. ``loss_module`` must be functional. Defaults to
            ``False``.
        normalize_cost_advantage (bool, optional): divide the cost advantages by their standard
            deviation, as :func:`~torchrl_safe.objectives.scaled_advantages` says. Steps for a cost
            are then as large as those for the reward, in whatever unit it is. Defaults to ``True``.

    Raises:
        TypeError: if ``separate_losses`` or ``normalize_cost_advantage`` is not a bool.
        ValueError: if ``loss_module`` reads no advantage, normalizes it or has no critic, or
            ``num_costs`` or ``tolerance`` is not usable; in a call, if the cost critic or the
            costs have another width than ``num_costs``.

    :meth:`set_keys` takes the keys of the wrapped loss, and of shape ``(*B, k)``: ``cost`` (read
    under ``"next"``), ``cost_value``, ``cost_advantage``, ``cost_value_target``.

    Outputs beside those of the wrapped loss: ``loss_cost_critic``, ``cost_explained_variance``
    (mean over the costs) and ``cost_violation_0`` ... ``cost_violation_{k-1}``, and with
    ``clip_value`` also ``cost_value_clip_fraction``.

    Examples:
        >>> import torch
        >>> from torchrl.objectives import ClipPPOLoss
        >>> from torchrl_safe.objectives import ViolationUpdater
        >>> from torchrl_safe.testing import make_batch, make_networks
        >>> actor, critic, cost_critic = make_networks(num_costs=2)
        >>> loss = CRPOLoss(ClipPPOLoss(actor, critic), cost_critic, num_costs=2)
        >>> updater = ViolationUpdater(loss, cost_limit=torch.tensor([1.0, 5.0]))
        >>> updater.step(torch.tensor([[2.0, 0.0], [4.0, 1.0]]))  # a row for each episode
        >>> losses = loss(loss.estimate_advantages(make_batch(num_costs=2)).reshape(-1))
        >>> losses["cost_violation_0"], losses["cost_violation_1"]
        (tensor(2.), tensor(-4.5000))
    """

    _schedulable_buffers = frozenset({"tolerance"})

    cost_buffers = ("cost_violation",)

    tolerance: Tensor

    def __init__(
        self,
        loss_module: LossModule,
        cost_critic_network: TensorDictModuleBase,
        *,
        num_costs: int = 1,
        tolerance: float | Tensor = 0.0,
        cost_critic_coeff: float = 1.0,
        separate_losses: bool = False,
        normalize_cost_advantage: bool = True,
    ) -> None:
        super().__init__(
            loss_module,
            cost_critic_network=cost_critic_network,
            num_costs=num_costs,
            cost_critic_coeff=cost_critic_coeff,
            separate_losses=separate_losses,
            normalize_cost_advantage=normalize_cost_advantage,
        )
        tolerance = coefficients("tolerance", tolerance, num_costs)
        self.register_buffer("tolerance", tolerance.to(self.cost_critic_coeff.device))

    def policy_losses(
        self, tensordict: TensorDictBase, advantage: Tensor, cost_advantage: Tensor
    ) -> TensorDictBase:
        scale = self.cost_advantage_scale if self.normalize_cost_advantage else None
        rectified = rectified_advantage(
            advantage, cost_advantage, self.cost_violation, self.tolerance, scale
        )
        return self.unconstrained(tensordict, rectified)
