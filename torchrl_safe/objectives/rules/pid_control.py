"""The multiplier rule that also reacts to how large a violation is and how fast it grows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor
from torchrl.objectives import LossModule

from torchrl_safe.objectives._checks import Checked, check_fraction, check_number
from torchrl_safe.objectives.rules.multipliers import MultiplierUpdater


class PIDControl(MultiplierUpdater):
    r"""Proportional, integral and derivative control of the multipliers; it needs a limit only.

    Presented in "Responsive Safety in Reinforcement Learning by PID Lagrangian Methods", Stooke,
    Achiam, Abbeel 2020 (https://arxiv.org/abs/2007.03964), algorithm 2. With the mean episode
    cost :math:`J` and the limit :math:`d`, both relative (``normalize``), and the moving average
    :math:`\bar J`, each batch does

    .. math::
        I &\leftarrow \max(I + k_i (J - d),\ 0) \\
        u &\leftarrow I + k_p (\bar J - d) + k_d (\bar J - \bar J_\mathrm{previous})_+ \\
        \lambda &\leftarrow \mathrm{clip}(f(u),\ 0,\ \mathrm{max})

    where :math:`f(u) = u` up to 1 and :math:`e^{u - 1}` above.

    **Above 1 the multiplier moves by factors.** The losses weigh the reward by
    :math:`1 / (1 + \lambda)`, so from 5 to 6 changes much less than from 0 to 1. Far above the
    limit a multiplier of 8 takes 26 batches; in steps of the same size it would take 75. The
    integral never exceeds what gives the bound.

    **The defaults have no unit.** Far above the limit the multiplier is 0.6 after the first batch,
    1 after five, 3 after 16 and at its bound of 20 after 35, whether costs are thousands or
    thousandths. It is bounded: without a bound it could grow until the reward has no weight, before
    the task is learnt. The defaults need advantages without a unit, which the losses have by
    default (``normalize_cost_advantage``).

    **As published**, with ``normalize=False``, :math:`\lambda` is :math:`u` clipped, the gains are
    in multiplier per unit of cost, and need tuning.

    The integral alone, with ``normalize=False``, is :class:`~torchrl_safe.objectives.DualAscent`
    with ``lr = ki``. It lags behind the policy, so cost and multiplier circle round their optimum.
    The proportional term damps that. The derivative term reacts to a rising cost before the limit
    is exceeded, and does not react to a falling one. The integral stays within the bounds of the
    multiplier, so it leaves a bound as soon as the violation changes its sign.

    The terms of ``kp`` and ``kd`` pass the noise of the batch costs on to the multiplier. The
    derivative term only adds, so a constant cost with noise of standard deviation s raises the
    multiplier by about ``0.56 * kd * s``. ``smoothing`` removes most of that, and delays the rule
    by about ``1 / (1 - smoothing)`` batches. The authors' code (rlpyt, ``projects/safe``) smooths
    with 0.95, over some 1900 large batches; its derivative over several batches is not in the
    paper's algorithm and not here.

    The division by :math:`1 + \sum_i \lambda_i` that the paper adds is in
    :func:`~torchrl_safe.objectives.penalized_advantage` and so in the losses, not here.

    Args:
        loss_module (LossModule): see :class:`MultiplierUpdater`. Its multiplier is where the
            integral starts.

    Keyword Args:
        cost_limit (float, Tensor or Mapping): see :class:`MultiplierUpdater`.
        kp (float, optional): proportional gain. Defaults to ``0.5``.
        ki (float, optional): integral gain, for each batch. Defaults to ``0.1``.
        kd (float, optional): derivative gain, for what the violation rose since the last batch.
            Defaults to ``0.0``.
        smoothing (float, optional): weight of the past in the moving average of the cost, at
            least 0 and less than 1. It starts at the first batch (algorithm 2 starts at 0, so that
            the first batch counts as a rise). Defaults to ``0.0``, the cost itself, as there.
        max_multiplier (float, optional): see :class:`MultiplierUpdater`. Defaults to ``20.0``,
            where the reward has a twentieth of the weight.
        pessimism (float, optional): see :class:`MultiplierUpdater`. Defaults to ``2.0``.
        normalize (bool, optional): make violations relative (see :class:`MultiplierUpdater`), and
            steps relative to a multiplier above 1. Defaults to ``True``.
        cost_names (sequence of str, optional): see :class:`MultiplierUpdater`.

    Raises:
        ValueError: if a gain is negative or not finite, or ``smoothing`` is outside ``[0, 1)``.

    If you assign or load a multiplier between two steps, the integral moves by as much.

    Examples:
        >>> import torch
        >>> from torchrl.objectives import LossModule
        >>> loss = LossModule()
        >>> loss.register_buffer("lagrange_multiplier", torch.zeros(1))
        >>> limit = torch.tensor([25.0])
        >>> updater = PIDControl(loss, cost_limit=limit, pessimism=0.0)
        >>> updater.step(torch.tensor([[26.0], [28.0]]))  # 2 above; a fifth of 25 is 5
        >>> loss.lagrange_multiplier  # 0.1 * 2 / 5 + 0.5 * 2 / 5
        tensor([0.2400])

        As published, in the unit of the cost:

        >>> loss.lagrange_multiplier.zero_()
        tensor([0.])
        >>> settings = {"max_multiplier": None, "pessimism": 0.0, "normalize": False}
        >>> updater = PIDControl(loss, cost_limit=1.0, kp=2.0, ki=0.5, kd=1.0, **settings)
        >>> updater.step(torch.tensor([[2.0]]))  # 0.5 * 1 + 2 * 1, and nothing to rise from
        >>> loss.lagrange_multiplier
        tensor([2.5000])
        >>> updater.step(torch.tensor([[3.0]]))  # 0.5 * (1 + 2) + 2 * 2 + 1 * (3 - 2)
        >>> loss.lagrange_multiplier
        tensor([6.5000])
    """

    kp = Checked(check_number)
    ki = Checked(check_number)
    kd = Checked(check_number)
    smoothing = Checked(check_fraction)

    def __init__(
        self,
        loss_module: LossModule,
        *,
        cost_limit: float | Tensor | Mapping[str, float],
        kp: float = 0.5,
        ki: float = 0.1,
        kd: float = 0.0,
        smoothing: float = 0.0,
        max_multiplier: float | None = 20.0,
        pessimism: float = 2.0,
        normalize: bool = True,
        cost_names: Sequence[str] | None = None,
    ) -> None:
        super().__init__(
            loss_module,
            cost_limit=cost_limit,
            max_multiplier=max_multiplier,
            pessimism=pessimism,
            normalize=normalize,
            cost_names=cost_names,
        )
        self.kp, self.ki, self.kd, self.smoothing = kp, ki, kd, smoothing
        multiplier = loss_module.lagrange_multiplier
        self.integral = self._parameter(multiplier).clone()
        # NaN until there has been a batch.
        self.smoothed_cost = torch.full_like(multiplier, float("nan"))
        self.last_multiplier = multiplier.clone()

    def next_multiplier(self, multiplier: Tensor, violation: Tensor) -> Tensor:
        # The cost, not the violation: a new limit is not a rise of the cost. (A normalized
        # violation has no unit in which the limit could be added.)
        limit = 0.0 if self.normalize else self.cost_limit
        cost = violation + limit
        previous = self.smoothed_cost.to(multiplier)
        previous = torch.where(previous.isnan(), cost, previous)
        smoothed = cost.lerp(previous, self.smoothing)
        # As in DualAscent, an assigned or loaded multiplier is never overwritten by a stale one.
        last = self.last_multiplier.to(multiplier)
        assigned = self._parameter(multiplier) - self._parameter(last)
        integral = (self.integral.to(multiplier) + assigned).add(violation, alpha=self.ki)
        integral = integral.clamp_min(0)
        if self.max_multiplier is not None:
            bound = torch.full_like(multiplier, self.max_multiplier)
            integral = integral.minimum(self._parameter(bound))
        rise = (smoothed - previous).clamp_min(0)
        parameter = integral + self.kp * (smoothed - limit) + self.kd * rise
        proposal = self._multiplier(parameter).clamp(0, self.max_multiplier)
        if proposal.isfinite().all():  # Else ``step`` refuses it, and nothing may have changed.
            self.integral, self.smoothed_cost, self.last_multiplier = integral, smoothed, proposal
        return proposal

    def _parameter(self, multiplier: Tensor) -> Tensor:
        """The sum of the terms that gives a multiplier."""
        if not self.normalize:
            return multiplier
        return torch.where(multiplier > 1, 1 + multiplier.log(), multiplier)

    def _multiplier(self, parameter: Tensor) -> Tensor:
        """The multiplier that a sum of the terms gives."""
        if not self.normalize:
            return parameter
        # Without a bound it must not overflow.
        return torch.where(parameter > 1, (parameter.clamp_max(80) - 1).exp(), parameter)

    def state_dict(self) -> dict[str, Any]:
        return {
            **super().state_dict(),
            "gains": torch.tensor([self.kp, self.ki, self.kd], dtype=torch.float64),
            "smoothing": self.smoothing,
            "integral": self.integral.clone(),
            "smoothed_cost": self.smoothed_cost.clone(),
            "last_multiplier": self.last_multiplier.clone(),
        }

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        super().load_state_dict(state_dict)
        self.kp, self.ki, self.kd = state_dict["gains"].tolist()
        self.smoothing = state_dict["smoothing"]
        self.integral = state_dict["integral"].clone()
        self.smoothed_cost = state_dict["smoothed_cost"].clone()
        self.last_multiplier = state_dict["last_multiplier"].clone()
