"""The multiplier rule whose defaults hold whatever the size of costs, rewards and limits."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor
from torchrl.objectives import LossModule

from torchrl_safe.objectives.rules.pid_control import PIDControl

# A kept limit is judged no more finely than this, however little the costs vary.
_SHARE_OF_LIMIT = 0.2


class RelativePID(PIDControl):
    r"""Control of the multipliers that needs no tuning: nothing in it has a unit.

    With the mean episode cost :math:`J`, the limit :math:`d` and the standard deviation
    :math:`\sigma_J` of the episode costs, each batch does

    .. math::
        v &= \mathrm{clip}\left(\frac{J - d}{\max(\sigma_J,\ 0.2\, d)},\ -1,\ 1\right) \\
        I &\leftarrow \mathrm{clip}(I + k_i v,\ 0,\ \mathrm{max}) \\
        \lambda &\leftarrow \mathrm{clip}(I + k_p v
            + k_d (v - v_\mathrm{previous})_+,\ 0,\ \mathrm{max})

    This is :class:`~torchrl_safe.objectives.PIDControl` (Stooke, Achiam, Abbeel 2020) with a
    **relative** violation: a limit that is far away is approached at the same pace whether costs
    are thousands or thousandths, and the noise of a batch counts for as much as the costs of
    single episodes vary. The multiplier is bounded, since one that has grown while the task was
    not learnt yet would leave the reward no weight to learn it.

    :math:`\sigma_J` is the largest of all batches so far, of which each new one forgets a fifth:
    divided by its own alone, a batch with few costs would count for more than one with many, and
    rare costs would exceed the limit on average.

    The multiplier is free of units only if the advantages are: make the loss with
    ``normalize_cost_advantage=True``, with which it says how many standard deviations of the
    reward advantage one standard deviation of the cost advantage is worth. Then costs and limit
    times 1,000, or rewards times 100, give the same multipliers.

    Args:
        loss_module (LossModule): see :class:`~torchrl_safe.objectives.MultiplierUpdater`. Its
            multiplier is where the integral starts.

    Keyword Args:
        cost_limit (float, Tensor or Mapping): see
            :class:`~torchrl_safe.objectives.MultiplierUpdater`. Not negative.
        kp (float, optional): proportional gain. Defaults to ``1.0``.
        ki (float, optional): integral gain, for each batch. Defaults to ``0.1``: far above the
            limit the multiplier is 1.1 after the first batch and 3 after twenty.
        kd (float, optional): derivative gain. Defaults to ``0.0``.
        max_multiplier (float, optional): upper bound of every multiplier, ``None`` for none.
            Defaults to ``10.0``.
        pessimism (float, optional): see :class:`~torchrl_safe.objectives.MultiplierUpdater`.
            Defaults to ``2.0``.
        cost_names (sequence of str, optional): see
            :class:`~torchrl_safe.objectives.MultiplierUpdater`.

    Raises:
        ValueError: if a limit or gain is negative or not finite.

    A multiplier that is assigned or loaded between two steps moves the integral by as much.

    Examples:
        >>> import torch
        >>> from torchrl.objectives import LossModule
        >>> loss = LossModule()
        >>> loss.register_buffer("lagrange_multiplier", torch.zeros(2))
        >>> updater = RelativePID(loss, cost_limit=torch.tensor([25.0, 0.025]), pessimism=0.0)
        >>> updater.step(torch.tensor([[26.0, 0.026], [28.0, 0.028]]))  # v = 2 / 5, twice
        >>> loss.lagrange_multiplier  # 0.1 * 0.4 + 1.0 * 0.4
        tensor([0.4400, 0.4400])
    """

    _forgotten = 0.2

    def __init__(
        self,
        loss_module: LossModule,
        *,
        cost_limit: float | Tensor | Mapping[str, float],
        kp: float = 1.0,
        ki: float = 0.1,
        kd: float = 0.0,
        max_multiplier: float | None = 10.0,
        pessimism: float = 2.0,
        cost_names: Sequence[str] | None = None,
    ) -> None:
        super().__init__(
            loss_module,
            cost_limit=cost_limit,
            kp=kp,
            ki=ki,
            kd=kd,
            max_multiplier=max_multiplier,
            pessimism=pessimism,
            normalize=True,
            cost_names=cost_names,
        )

    def next_multiplier(self, multiplier: Tensor, violation: Tensor) -> Tensor:
        return super().next_multiplier(multiplier, violation.clamp(-1, 1))

    def _scale_of(self, episode_cost: Tensor) -> Tensor:
        limit, mean = self.cost_limit.to(episode_cost), episode_cost.mean(0)
        scale = _SHARE_OF_LIMIT * limit
        if len(episode_cost) > 1:
            scale = torch.maximum(scale, episode_cost.std(0))
        # Under a limit of 0 costs that are all the same have no other scale.
        scale = torch.where(scale > 0, scale, mean)
        return scale.clamp_max(torch.finfo(scale.dtype).max)
