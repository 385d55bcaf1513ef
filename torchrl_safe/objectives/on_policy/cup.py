"""Constrained update projection: improve the policy, then project it."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import (
    ProbabilisticTensorDictSequential,
    TensorDictModuleBase,
    TensorDictParams,
)
from torch import Tensor
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE, ValueEstimatorBase

from torchrl_safe.objectives._checks import get_or_raise
from torchrl_safe.objectives._reduction import reduced
from torchrl_safe.objectives.on_policy.constrained import ConstrainedPPO
from torchrl_safe.objectives.on_policy.policies import actor_params, divergence


class CUPLoss(ConstrainedPPO, ClipPPOLoss):
    r"""Improves the policy with clipped PPO, then projects it towards the limits of k costs.

    Presented in "Constrained Update Projection Approach to Safe Policy Optimization", Yang et al.
    2022 (https://arxiv.org/abs/2209.07089). You go through a batch in two phases, each of as many
    epochs as you like:

    1. *improvement*: a call of the loss is :class:`~torchrl.objectives.ClipPPOLoss` on the reward,
       bit for bit, beside the loss of the cost critic;
    2. *projection*: :meth:`start_projection`, called once, stores the improved policy,
       :math:`\pi_{k + 1/2}`; then call :meth:`projection_loss` in place of the loss.

    ``lagrange_multiplier``, the paper's :math:`\nu`, is a buffer of shape ``(k,)`` that a
    :class:`~torchrl_safe.objectives.MultiplierUpdater` moves, once for each collected batch; the
    paper's is :class:`~torchrl_safe.objectives.DualAscent`. It acts in the projection only.

    The divergence is :math:`D_{KL}(\pi_\theta \| \pi_{k + 1/2})`, as in the authors' code
    (OmniSafe), and must be one that :func:`torch.distributions.kl_divergence` knows, of each part
    of a composite action.

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
        ValueError: if ``num_costs`` or ``multiplier_init`` is not usable, or the discount of the
            costs is 1; in a call, if the cost critic or the costs have another width than
            ``num_costs``.

    Keys beside those of ``ClipPPOLoss``, all of shape ``(*B, k)``: ``cost`` (read under
    ``"next"``), ``cost_value``, ``cost_advantage``, ``cost_value_target``.

    Outputs beside those of ``ClipPPOLoss``: ``loss_cost_critic``, ``cost_explained_variance``
    (mean over the costs), ``lagrange_multiplier_0`` ... ``lagrange_multiplier_{k-1}``, and with
    ``clip_value`` also ``cost_value_clip_fraction``. Outputs of the projection:
    ``loss_projection`` and ``kl``.

    Examples:
        >>> import torch
        >>> from torchrl_safe.objectives import DualAscent
        >>> from torchrl_safe.testing import make_batch, make_networks
        >>> loss = CUPLoss(*make_networks(num_costs=2), num_costs=2)
        >>> updater = DualAscent(loss, cost_limit=torch.tensor([1.0, 5.0]), lr=0.01)
        >>> updater.step(torch.tensor([[2.0, 0.0], [4.0, 1.0]]))  # a row for each episode
        >>> data = loss.estimate_advantages(make_batch(num_costs=2)).reshape(-1)
        >>> losses = loss(data)  # The first phase: some epochs of these,
        >>> loss.start_projection()
        >>> projection = loss.projection_loss(data)  # then some of these.
        >>> sorted(projection.keys()), projection["kl"]
        (['kl', 'loss_projection'], tensor(0.))
    """

    improved_actor_params: TensorDictParams

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        critic_network: TensorDictModuleBase,
        cost_critic_network: TensorDictModuleBase,
        *,
        num_costs: int = 1,
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
        self.improved_actor_params = TensorDictParams(
            actor_params(self).data.clone(), no_convert=True
        )
        self._has_started = False
        # A loss that is loaded has the improved policy of the state, if there is one.
        self.register_buffer("has_improved_actor", torch.zeros((), dtype=torch.bool))
        self.register_load_state_dict_post_hook(_read_start)

    def policy_losses(
        self, tensordict: TensorDictBase, advantage: Tensor, cost_advantage: Tensor
    ) -> TensorDictBase:
        policy = self.evaluate(tensordict)
        losses = self.unconstrained(tensordict, advantage, policy)
        # The phase ends by it. TorchRL's is a mean over all steps, with those that do not count.
        kl = reduced(self, policy.kl_approx.detach(), tensordict, reduction="mean")
        return losses.set("kl_approx", kl)

    def start_projection(self) -> None:
        """Keeps the policy as it is now, for :meth:`projection_loss` to stay near it."""
        kept, present = self.improved_actor_params.data, actor_params(self).data
        if any(kept[key].shape != value.shape for key, value in present.items(True, True)):
            # A lazy actor has got its shapes since.
            self.improved_actor_params = TensorDictParams(present.clone(), no_convert=True)
        else:
            kept.update_(present)
        self.has_improved_actor.fill_(True)
        self._has_started = True

    def projection_loss(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Loss of the second phase. It trains the policy alone.

        Args:
            tensordict (TensorDictBase): data of the batch that the first phase has learned from,
                with its ``cost_advantage``.

        Returns:
            A tensordict with ``loss_projection``, the divergence from the improved policy plus
            the penalty of the costs, reduced like the other losses, and ``kl``, the mean of that
            divergence.

        Raises:
            RuntimeError: if :meth:`start_projection` was never called.
            KeyError: if the data have no ``cost_advantage``.
            ValueError: if the costs have another width than ``num_costs``.
        """
        if not self._has_started:
            raise RuntimeError("Call start_projection before projection_loss, once in each batch.")
        tensordict = tensordict.clone(False)
        cost_advantage = get_or_raise(tensordict, self.tensor_keys.cost_advantage)
        self._check_width(self.tensor_keys.cost_advantage, cost_advantage)
        improved = self._improved_policy(tensordict)
        shape = cost_advantage.shape[:-1]
        policy = self.evaluate(tensordict).joint(shape)
        kl = divergence(policy.distribution, improved, shape)
        cost = (self.lagrange_multiplier * cost_advantage).sum(-1, keepdim=True)
        objective = kl + self._cost_scale() * policy.ratio() * cost
        return TensorDict(
            loss_projection=reduced(self, objective, tensordict).squeeze(-1),
            kl=reduced(self, kl.detach(), tensordict, reduction="mean"),
        )

    @torch.no_grad()
    def _improved_policy(self, tensordict: TensorDictBase) -> torch.distributions.Distribution:
        inputs = tensordict.select(*self.actor_network.in_keys)
        with self.improved_actor_params.to_module(self.actor_network, preserve_module_state=False):
            return self.actor_network.get_dist(inputs)

    def _check_cost_value_estimator(self, estimator: ValueEstimatorBase) -> None:
        if not isinstance(estimator, GAE):
            raise ValueError(
                "estimator must be a GAE, whose trace decay the projection needs, got "
                f"{type(estimator).__name__}."
            )
        if not estimator.gamma < 1:  # An episode has 1 / (1 - gamma) steps.
            raise ValueError(f"gamma of the costs must be below 1, got {estimator.gamma.item()}.")

    def _cost_scale(self) -> Tensor:
        estimator = self.cost_value_estimator
        return (1 - estimator.gamma * estimator.lmbda) / (1 - estimator.gamma)


def _read_start(loss: CUPLoss, *_: Any) -> None:
    # Compiled code could not branch on the buffer.
    loss._has_started = bool(loss.has_improved_actor)
