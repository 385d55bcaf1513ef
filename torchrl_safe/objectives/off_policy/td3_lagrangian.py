"""Twin delayed deep deterministic policy gradients with Lagrange multipliers for the costs."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictParams
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor
from torchrl.envs.utils import step_mdp
from torchrl.objectives import TD3Loss
from torchrl.objectives.utils import distance_loss

from torchrl_safe.objectives.off_policy.constrained import ConstrainedQLoss


class TD3LagrangianLoss(ConstrainedQLoss, TD3Loss):
    r"""TD3 loss under constraints on k expected costs.

    The actor of "Addressing Function Approximation Error in Actor-Critic Methods", Fujimoto et
    al. 2018, https://arxiv.org/abs/1802.09477, maximizes

    .. math::
        \frac{Q_1(s, \pi(s)) - \sum_i \lambda_i \max_m Q_{c_i, m}(s, \pi(s))}
             {1 + \sum_i \lambda_i}

    This class is a thin specialization of :class:`~torchrl.objectives.TD3Loss`, whose arguments,
    keys and outputs it keeps; with every multiplier at zero its outputs, gradients and random
    numbers are those of ``TD3Loss``, bit for bit. It differs from it as
    :class:`~torchrl_safe.objectives.SACLagrangianLoss` differs from ``SACLoss``; arguments, keys
    and outputs beside the parent's, and the reasons, are described there. The cost critics are
    bootstrapped with the same smoothed next action as the reward's, and the largest of their
    predictions counts in the actor's objective too, where the reward has its first critic alone.

    Args:
        actor_network (TensorDictModule): deterministic actor.
        qvalue_network (TensorDictModule or list of them): critic of the reward, writes
            ``"state_action_value"`` of shape ``(*B, 1)``.
        cost_qvalue_network (TensorDictModule or list of them): critic of the costs, writes
            ``"state_action_cost_value"`` of shape ``(*B, k)``.

    Keyword Args:
        num_costs (int, optional): number k of costs. Defaults to ``1``.
        num_cost_qvalue_nets (int, optional): number of cost critics. Defaults to ``2``.
        multiplier_init (float or Tensor, optional): multiplier to start with, one number or k.
            Defaults to ``0.0``.
        **kwargs: every keyword argument of :class:`~torchrl.objectives.TD3Loss`.

    Raises:
        ValueError: if ``num_costs``, ``multiplier_init`` or the number of cost critics is not
            usable; in a call, if the cost critics or the costs have another width than
            ``num_costs``.
        KeyError: in a call, if the batch has no cost.

    Examples:
        >>> from torchrl.objectives import SoftUpdate
        >>> from torchrl_safe.testing import make_q_networks, make_transitions
        >>> loss = TD3LagrangianLoss(*make_q_networks(deterministic=True), bounds=(-1.0, 1.0))
        >>> targets = SoftUpdate(loss, tau=0.005)
        >>> losses = loss(make_transitions())
        >>> sorted(key for key in losses.keys() if key.startswith("loss_"))
        ['loss_actor', 'loss_cost_qvalue', 'loss_qvalue']
    """

    @dataclass
    class _AcceptedKeys(TD3Loss._AcceptedKeys):
        cost: NestedKey = "cost"
        state_action_cost_value: NestedKey = "state_action_cost_value"

    default_keys = _AcceptedKeys

    # The parent keeps its next action to itself, and its smoothing is random: drawing it again
    # would be another action and move the random numbers. Both methods are written anew.

    def _qvalue(self, tensordict: TensorDictBase, params: TensorDictParams) -> Tensor:
        """Values of the N reward critics, shape ``(N, *B)``."""
        inputs = tensordict.select(*self.qvalue_network.in_keys, strict=False)
        values = self._ensemble(self.qvalue_network, inputs, params, copies=self.num_qvalue_nets)
        return values.get(self.tensor_keys.state_action_value).squeeze(-1)

    def actor_loss(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """Loss of the actor.

        Args:
            tensordict (TensorDictBase): data with the inputs of actor and critics.

        Returns:
            The loss, reduced; the values of the actor's actions, shape ``(N, *B)``.
        """
        with self.actor_network_params.to_module(self.actor_network, preserve_module_state=False):
            acted = self.actor_network(tensordict.copy())
        value = self._qvalue(acted, self.qvalue_network_params.detach())
        loss = self._reduced(-self.penalized_objective(value[0], acted), tensordict)
        return loss, {"state_action_value_actor": value.detach()}

    @torch.no_grad()
    def _act_next(self, tensordict: TensorDictBase) -> TensorDictBase:
        """The next state with the target actor's action, smoothed."""
        key = self.tensor_keys.action
        noise = torch.randn_like(tensordict.get(key)) * self.policy_noise
        acted = step_mdp(tensordict).select(*self.actor_network.in_keys, strict=False)
        with self.target_actor_network_params.to_module(
            self.actor_network, preserve_module_state=False
        ):
            acted = self.actor_network(acted)
        action = acted.get(key) + noise.clamp(-self.noise_clip, self.noise_clip)
        # A spec in double precision would make the action double.
        acted.set(key, action.clamp(self.min_action.to(action), self.max_action.to(action)))
        return tensordict.get("next").copy().update(acted)

    def value_loss(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """Loss of the reward critics.

        Args:
            tensordict (TensorDictBase): a batch. The smoothed next action is written under its
                ``"next"``, where :meth:`cost_qvalue_loss` finds it.

        Returns:
            The loss, reduced; predictions, targets and temporal differences for the outputs.
        """
        keys = self.tensor_keys
        following = self._act_next(tensordict)
        tensordict.set("next", following)
        with torch.no_grad():
            next_value = self._qvalue(following, self.target_qvalue_network_params).min(0)[0]
        data = tensordict.clone(False)
        data.set(unravel_key(("next", keys.state_action_value)), next_value.unsqueeze(-1))
        target = self.value_estimator.value_estimate(data).squeeze(-1)
        value = self._qvalue(tensordict, self.qvalue_network_params)
        loss = distance_loss(value, target.expand_as(value), loss_function=self.loss_function)
        metadata = {
            "td_error": (value - target).pow(2),
            "next_state_value": next_value,
            "pred_value": value.detach(),
            "target_value": target.detach(),
        }
        return self._reduced(loss.sum(0), tensordict), metadata
