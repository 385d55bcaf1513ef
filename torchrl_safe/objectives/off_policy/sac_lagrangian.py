"""Soft actor-critic with Lagrange multipliers for the costs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import (
    ProbabilisticTensorDictSequential,
    TensorDictModuleBase,
    TensorDictParams,
)
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.objectives import SACLoss
from torchrl.objectives.sac import compute_rsample_log_prob

from torchrl_safe.objectives.off_policy.constrained import ConstrainedQLoss


class SACLagrangianLoss(ConstrainedQLoss, SACLoss):
    r"""SAC loss under constraints on k expected costs.

    Presented in "Learning to Walk in the Real World with Minimal Human Effort", Ha et al. 2020,
    https://arxiv.org/abs/2002.08550. The actor maximizes

    .. math::
        \frac{\min_n Q_n(s, a) - \alpha \log \pi(a | s)
              - \sum_i \lambda_i \max_m Q_{c_i, m}(s, a)}{1 + \sum_i \lambda_i}

    This class is a thin specialization of :class:`~torchrl.objectives.SACLoss` (its second
    version, without a state value), whose arguments, keys and outputs it keeps; with every
    multiplier at zero its outputs, gradients and random numbers are those of ``SACLoss``, bit for
    bit. The differences are:

    - an ensemble of critics predicts the k costs, each from the same next action as the reward's;
      its loss is ``"loss_cost_qvalue"``. The **largest** of several predictions of a cost counts,
      in targets and in the actor's objective, as the smallest does for the reward: the dangerous
      estimate is the one that promises too little cost;
    - the entropy is divided by :math:`1 + \sum_i \lambda_i` along with the reward. The quotient is
      the Lagrangian of the maximum-entropy problem up to a positive factor, so that a temperature
      means the same, in units of reward, whatever the multipliers are;
    - ``lagrange_multiplier`` is a buffer of shape ``(k,)``. No optimizer and no forward changes
      it: a :class:`~torchrl_safe.objectives.MultiplierUpdater` does, in place, once for each
      collected batch, with the costs of the episodes that ended in it. The target networks of the
      cost critics move with :class:`~torchrl.objectives.SoftUpdate`, like the others.

    ``SACLoss`` and ``CQLLoss`` keep their own multipliers as the logarithm of a parameter that
    an optimizer moves along a loss on the minibatch. That does not work for a limit on the cost of
    an episode: a minibatch of a replay buffer comes from many old policies, and critics predict
    discounted costs. For the same rule, a logarithm moved by Adam, on the costs of episodes, use
    ``DualAscent(loss, cost_limit=d, lr=lr, optimizer=torch.optim.Adam,
    parametrization=torch.distributions.ExpTransform())``; it needs a ``multiplier_init`` above 0.

    Args:
        actor_network (ProbabilisticTensorDictSequential): stochastic actor.
        qvalue_network (TensorDictModule or list of them): critic of the reward, writes
            ``"state_action_value"`` of shape ``(*B, 1)``.
        cost_qvalue_network (TensorDictModule or list of them): critic of the costs, writes
            ``"state_action_cost_value"`` of shape ``(*B, k)``. One network is duplicated and
            its copies are drawn anew, as with ``qvalue_network``.

    Keyword Args:
        num_costs (int, optional): number k of costs. Defaults to ``1``.
        num_cost_qvalue_nets (int, optional): number of cost critics. Defaults to ``2``.
        multiplier_init (float or Tensor, optional): multiplier to start with, one number or k.
            Defaults to ``0.0``.
        **kwargs: every keyword argument of :class:`~torchrl.objectives.SACLoss`, except
            ``value_network``. ``loss_function``, ``delay_qvalue``, ``separate_losses`` and
            ``deactivate_vmap`` act on the cost critics too.

    Raises:
        TypeError: if a ``value_network`` is given.
        ValueError: if ``num_costs``, ``multiplier_init`` or the number of cost critics is not
            usable; in a call, if the cost critics or the costs have another width than
            ``num_costs``.
        KeyError: in a call, if the batch has no cost.

    Keys beside those of ``SACLoss``, both of shape ``(*B, k)``: ``cost`` (read under ``"next"``)
    and ``state_action_cost_value``. The priority is the reward's temporal difference alone.

    Outputs beside those of ``SACLoss``: ``loss_cost_qvalue`` and ``lagrange_multiplier_0`` ...
    ``lagrange_multiplier_{k-1}``. With ``reduction="none"`` the multipliers are left out, or kept
    as non-tensors, as ``alpha`` is. The targets' discount of the costs is set with
    ``loss.make_cost_value_estimator(gamma=0.99)``.

    Examples:
        >>> from torchrl.objectives import SoftUpdate
        >>> from torchrl_safe.objectives import DualAscent
        >>> from torchrl_safe.testing import make_q_networks, make_transitions
        >>> networks = make_q_networks(num_costs=3)
        >>> loss = SACLagrangianLoss(*networks, num_costs=3, target_entropy=-2.0)
        >>> targets = SoftUpdate(loss, tau=0.005)
        >>> updater = DualAscent(loss, cost_limit=[25.0, 5.0, 1.0], lr=0.01)
        >>> losses = loss(make_transitions(num_costs=3))
        >>> sorted(key for key in losses.keys() if key.startswith("loss_"))
        ['loss_actor', 'loss_alpha', 'loss_cost_qvalue', 'loss_qvalue']
    """

    @dataclass
    class _AcceptedKeys(SACLoss._AcceptedKeys):
        cost: NestedKey = "cost"
        state_action_cost_value: NestedKey = "state_action_cost_value"

    default_keys = _AcceptedKeys

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        qvalue_network: TensorDictModuleBase | Sequence[TensorDictModuleBase],
        cost_qvalue_network: TensorDictModuleBase | Sequence[TensorDictModuleBase],
        *,
        num_costs: int = 1,
        num_cost_qvalue_nets: int = 2,
        multiplier_init: float | Tensor = 0.0,
        **kwargs: Any,
    ) -> None:
        if kwargs.get("value_network") is not None:
            raise TypeError(
                "SACLagrangianLoss is SAC without a state value: value_network is not supported."
            )
        super().__init__(
            actor_network,
            qvalue_network,
            cost_qvalue_network,
            num_costs=num_costs,
            num_cost_qvalue_nets=num_cost_qvalue_nets,
            multiplier_init=multiplier_init,
            **kwargs,
        )

    # The parent keeps the actions it draws to itself, and a second draw would be another action
    # and move the random numbers: the two methods that draw are written anew. Of TorchRL's private
    # names they need _alpha, which keeps the temperature within its bounds as it is read, and
    # _compute_target_v2, the smallest method around the next action.

    def _qvalue(self, tensordict: TensorDictBase, params: TensorDictParams) -> Tensor:
        """Values of the N reward critics, shape ``(N, *B, 1)``."""
        inputs = tensordict.select(*self.qvalue_network.in_keys, strict=False)
        values = self._ensemble(self.qvalue_network, inputs, params)
        return values.get(self.tensor_keys.state_action_value)

    def _draw_action(self, tensordict: TensorDictBase) -> tuple[Tensor, Tensor]:
        with (
            set_exploration_type(ExplorationType.RANDOM),
            self.actor_network_params.to_module(self.actor_network, preserve_module_state=False),
        ):
            return compute_rsample_log_prob(self.actor_network.get_dist(tensordict))

    def _draw_next_action(self, tensordict: TensorDictBase) -> tuple[Tensor, Tensor]:
        done = tensordict.get(self.tensor_keys.done, None)
        if done is None or not self.skip_done_states:
            return self._draw_action(tensordict)
        kept = ~done.squeeze(-1)
        draws = self._draw_action(tensordict[kept])
        action, log_prob = (
            draw.new_zeros((*kept.shape, *draw.shape[1:])).index_put((kept,), draw)
            for draw in draws
        )
        return action, log_prob

    @torch.no_grad()
    def _compute_target_v2(self, tensordict: TensorDictBase) -> Tensor:
        keys = self.tensor_keys
        following = tensordict.get("next").copy()
        action, log_prob = self._draw_next_action(following)
        following.set(keys.action, action)
        tensordict.set("next", following)  # Where cost_qvalue_loss finds the action.
        value = self._qvalue(following, self.target_qvalue_network_params)
        value = (value - self._alpha * log_prob.unsqueeze(-1)).min(0)[0]
        data = tensordict.clone(False)
        data.set(unravel_key(("next", self.value_estimator.tensor_keys.value)), value)
        return self.value_estimator.value_estimate(data).squeeze(-1)

    def actor_loss(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """Loss of the actor.

        Args:
            tensordict (TensorDictBase): data with the inputs of actor and critics.

        Returns:
            The loss, reduced; the log-probability of the actions drawn, shape ``(*B,)``.
        """
        action, log_prob = self._draw_action(tensordict)
        acted = tensordict.copy().set(self.tensor_keys.action, action)
        value = self._qvalue(acted, self.qvalue_network_params.detach())
        objective = value.min(0)[0].squeeze(-1) - self._alpha * log_prob
        loss = self._reduced(-self.penalized_objective(objective, acted), tensordict)
        return loss, {"log_prob": log_prob.detach()}

    def _report_multipliers(self, losses: TensorDictBase) -> None:
        if self.reduction != "none":
            super()._report_multipliers(losses)
        elif self.scalar_output_mode == "non_tensor":
            for index, multiplier in enumerate(self.lagrange_multiplier.clone().unbind()):
                losses.set_non_tensor(f"lagrange_multiplier_{index}", multiplier)
