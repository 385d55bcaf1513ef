"""The clipped surrogate of the costs, for losses that penalize it."""

from __future__ import annotations

import abc
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.objectives.value import GAE, ValueEstimatorBase

from torchrl_safe.objectives._checks import check_episode_length, check_length_known
from torchrl_safe.objectives._reduction import reduced
from torchrl_safe.objectives.functional import per_step
from torchrl_safe.objectives.on_policy.constrained import ConstrainedPPO
from torchrl_safe.objectives.on_policy.policies import Policy


def clipped_cost_surrogate(
    log_ratio: Tensor,
    cost_advantage: Tensor,
    bounds: tuple[Tensor, Tensor],
    log_correction: Tensor | None = None,
) -> Tensor:
    r"""PPO's surrogate with the sign of a cost, the larger of two products, from where it starts.

    .. math::
        \max(r A_c,\ \mathrm{clip}(r) A_c) - A_c

    The last term has mean zero over the collected batch, but not over a minibatch. Without it, a
    loss would take the noise of a minibatch for a change of the policy, and a convex penalty turns
    that into a bias.

    Args:
        log_ratio (Tensor): logarithm of the ratio r that is clipped, shape ``(*B, 1)``.
        cost_advantage (Tensor): advantage of each of the k costs, shape ``(*B, k)``.
        bounds (tuple of Tensor): logarithms of the smallest and the largest clipped ratio.
        log_correction (Tensor, optional): logarithm of what both products are weighted by, shape
            ``(*B, 1)``. Defaults to ``None``: they are not.

    Returns:
        The surrogate of each sample and cost, shape ``(*B, k)``.
    """
    ratio, clipped = log_ratio.exp(), log_ratio.clamp(*bounds).exp()
    surrogate = torch.maximum(ratio * cost_advantage, clipped * cost_advantage) - cost_advantage
    return surrogate if log_correction is None else log_correction.exp() * surrogate


class CostSurrogate(ConstrainedPPO):
    """PPO's losses, and a penalty on the mean surrogates of the costs."""

    cost_buffers = ("cost_violation",)
    keeps_cost_unit = True
    policy_out_keys = ("loss_penalty",)

    def __init__(self, *args: Any, episode_length: float | None = None, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.episode_length = episode_length
        if self.reduction != "mean":
            raise ValueError(
                "reduction must be 'mean', since the penalty is a function of the batch mean, got "
                f"{self.reduction!r}."
            )
        self._asymmetric = isinstance(kwargs.get("clip_epsilon"), tuple | list)

    @property
    def episode_length(self) -> float | None:
        """Mean number of steps of an episode. You can set what the constructor takes."""
        return self._episode_length

    @episode_length.setter
    def episode_length(self, episode_length: float | None) -> None:
        length = check_episode_length("episode_length", episode_length)
        if self._cost_value_estimator is not None:
            check_length_known(length, self._cost_value_estimator.gamma)
        self._episode_length = length

    @abc.abstractmethod
    def penalty(self, surrogate: Tensor, scale: Tensor | float) -> Tensor:
        """Returns the penalty of each cost, shape ``(k,)``.

        Args:
            surrogate (Tensor): what :meth:`cost_surrogate` returns, shape ``(k,)``.
            scale (Tensor or float): the share of one step in an episode (:func:`per_step`).
        """

    def policy_losses(
        self, tensordict: TensorDictBase, advantage: Tensor, cost_advantage: Tensor
    ) -> TensorDictBase:
        policy = self.evaluate(tensordict)
        # PPO's own losses, for the reward.
        losses = self.unconstrained(tensordict, advantage, policy)
        # E[max(r A_c, clip(r) A_c) - A_c]
        surrogate = self.cost_surrogate(tensordict, policy, cost_advantage)
        # 1 - gamma
        scale = per_step(self.episode_length, self.cost_value_estimator.gamma)
        losses.set("loss_penalty", self.penalty(surrogate, scale).sum())
        return losses

    def cost_surrogate(
        self, tensordict: TensorDictBase, policy: Policy, cost_advantage: Tensor
    ) -> Tensor:
        """Mean of :func:`clipped_cost_surrogate` for each cost, shape ``(k,)``."""
        low = self.clip_epsilon_low if self._asymmetric else self.clip_epsilon
        high = self.clip_epsilon_high if self._asymmetric else self.clip_epsilon
        joint = policy.joint(cost_advantage.shape[:-1])
        surrogate = clipped_cost_surrogate(
            joint.log_ratio,
            cost_advantage,
            ((-low).log1p(), high.log1p()),
            joint.log_correction,
        )
        columns = surrogate.unbind(-1)
        return torch.stack([reduced(self, each, tensordict, reduction="mean") for each in columns])

    def _check_cost_value_estimator(self, estimator: ValueEstimatorBase) -> None:
        check_length_known(self.episode_length, estimator.gamma)
        if isinstance(estimator, GAE) and estimator.average_gae:
            raise ValueError(
                "estimator must not have average_gae=True: the cost advantage is compared with a "
                "violation, in the unit of the cost."
            )
