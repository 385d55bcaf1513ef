"""Constrained problems of one step whose best policies and multipliers are known."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.data import Bounded, Composite, LazyTensorStorage, OneHot, ReplayBuffer, Unbounded
from torchrl.data.replay_buffers.samplers import SamplerWithoutReplacement
from torchrl.envs import EnvBase
from torchrl.modules import OneHotCategorical, ProbabilisticActor, ValueOperator
from torchrl.objectives import LossModule

from torchrl_safe.testing._losses import require, total
from torchrl_safe.testing._random import seeded

with warnings.catch_warnings():  # TorchRL 0.14 deprecates a base class that it still derives from.
    warnings.filterwarnings("ignore", "Creating .* WeightUpdaterBase", DeprecationWarning)
    from torchrl.collectors import Collector

Losses = Callable[[TensorDictBase], TensorDictBase]


class _OneStep(EnvBase):
    """Episodes of one step, many side by side; the observation is always 1."""

    def __init__(self, num_costs: int, num_envs: int) -> None:
        if num_costs not in (1, 2):
            raise ValueError(f"num_costs must be 1 or 2, got {num_costs!r}.")
        super().__init__(batch_size=[num_envs])
        self.num_costs = num_costs
        self.observation_spec = Composite(observation=Unbounded((num_envs, 1)), shape=[num_envs])
        self.reward_spec = Composite(
            reward=Unbounded((num_envs, 1)), cost=Unbounded((num_envs, num_costs)), shape=[num_envs]
        )

    def _outcome(self, action: Tensor) -> tuple[Tensor, Tensor]:
        """Reward of shape (N, 1) and costs of shape (N, 2)."""
        raise NotImplementedError

    def _reset(self, tensordict: TensorDictBase | None = None, **_: Any) -> TensorDictBase:
        size = self.batch_size
        return TensorDict(observation=torch.ones(*size, 1), batch_size=size)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        size = self.batch_size
        reward, cost = self._outcome(tensordict["action"])
        done = torch.ones(*size, 1, dtype=torch.bool)
        return TensorDict(
            observation=torch.ones(*size, 1),
            reward=reward,
            cost=cost[:, : self.num_costs],
            done=done,
            terminated=done,
            batch_size=size,
        )

    def _set_seed(self, seed: int | None) -> None:
        torch.manual_seed(seed or 0)


class ConstrainedBandit(_OneStep):
    r"""A bandit with two actions and a known constrained optimum.

    Action A pays reward 1 at cost 1, action B pays nothing and costs nothing. With p the
    probability of A, the expected reward and the expected cost are both p, so under the limit d
    the best policy has p = d. A second cost, 1 for B, has the limit 0.9 and the mean 1 - d = 0.7
    at the optimum: it never binds.

    The observation is constant, so critics are numbers that drop out when an advantage is centred.
    With both advantages standardized, as ``estimate_advantages`` leaves them,

    .. math::
        A_r - \lambda A_c = \frac{1 - \lambda}{\sqrt{p (1 - p)}} (1[A] - p),

    which vanishes at :math:`\lambda = 1`. (For a loss with ``normalize_cost_advantage=False`` it
    is :math:`\lambda = 1 / \sqrt{d (1 - d)}`. The scale of the cost advantages falls slowly, so
    that after some hundred batches the multiplier is still a few percent above 1.)

    Args:
        num_costs (int, optional): ``2``, or ``1`` to leave the second cost out.
            Defaults to ``2``.
        num_envs (int, optional): copies of the problem side by side. Defaults to ``512``.

    Examples:
        >>> from torchrl.envs.utils import check_env_specs
        >>> env = ConstrainedBandit()
        >>> check_env_specs(env)
        >>> env.cost_limit
        tensor([0.3000, 0.9000])
    """

    #: The probability of action A in the best policy, which is the limit of the first cost.
    optimal_probability = 0.3

    def __init__(self, num_costs: int = 2, num_envs: int = 512) -> None:
        super().__init__(num_costs, num_envs)
        self.action_spec = OneHot(2, shape=(num_envs, 2))

    @property
    def cost_limit(self) -> Tensor:
        """Limits of the expected costs, shape (k,)."""
        return torch.tensor([self.optimal_probability, 0.9])[: self.num_costs]

    @property
    def optimal_multiplier(self) -> Tensor:
        """Multipliers at which the best policy has no gradient, shape (k,)."""
        return torch.tensor([1.0, 0.0])[: self.num_costs]

    def _outcome(self, action: Tensor) -> tuple[Tensor, Tensor]:
        cost = action.float()
        return cost[:, :1], cost

    def make_networks(self) -> tuple[ProbabilisticActor, ValueOperator, ValueOperator]:
        """Makes an actor, a critic and a cost critic, each with a weight and a bias to learn."""
        actor = ProbabilisticActor(
            TensorDictModule(nn.Linear(1, 2), ["observation"], ["logits"]),
            in_keys=["logits"],
            distribution_class=OneHotCategorical,
            return_log_prob=True,
        )
        critic = ValueOperator(nn.Linear(1, 1), in_keys=["observation"])
        cost_critic = ValueOperator(
            nn.Linear(1, self.num_costs), in_keys=["observation"], out_keys=["cost_value"]
        )
        return actor, critic, cost_critic


class ContinuousConstrainedBandit(_OneStep):
    r"""A bandit with an action a in [-1, 1] and a known constrained optimum.

    The reward is :math:`-(a - 1)^2`, a first cost is a and has the limit d, a second is 1 - a and
    has the limit 1.9. The Lagrangian :math:`-(a - 1)^2 - \lambda (a - d)` has its maximum at
    :math:`a = 1 - \lambda / 2`, so that a = d for :math:`\lambda = 2 (1 - d)`; the second cost is
    1 - d = 0.7 then and never binds.

    With an entropy of weight :math:`\alpha` the best policy has a density proportional to
    :math:`\exp(-((a - 1)^2 + \lambda a) / \alpha)`: a normal one with the mean above and the
    variance :math:`\alpha / 2`.

    Args:
        num_costs (int, optional): ``2``, or ``1`` to leave the second cost out.
            Defaults to ``2``.
        num_envs (int, optional): copies of the problem side by side. Defaults to ``64``.

    Examples:
        >>> from torchrl.envs.utils import check_env_specs
        >>> env = ContinuousConstrainedBandit()
        >>> check_env_specs(env)
        >>> env.optimal_multiplier
        tensor([1.4000, 0.0000])
    """

    #: The best action, which is the limit of the first cost.
    optimal_action = 0.3

    def __init__(self, num_costs: int = 2, num_envs: int = 64) -> None:
        super().__init__(num_costs, num_envs)
        self.action_spec = Bounded(-1, 1, (num_envs, 1))

    @property
    def cost_limit(self) -> Tensor:
        """Limits of the expected costs, shape (k,)."""
        return torch.tensor([self.optimal_action, 1.9])[: self.num_costs]

    @property
    def optimal_multiplier(self) -> Tensor:
        """Multipliers at which the best action is the best there is, shape (k,)."""
        return torch.tensor([2 * (1 - self.optimal_action), 0.0])[: self.num_costs]

    def _outcome(self, action: Tensor) -> tuple[Tensor, Tensor]:
        return -(action - 1).square(), torch.cat([action, 1 - action], -1)


def run_epochs(
    losses: Losses,
    optimizer: torch.optim.Optimizer,
    buffer: ReplayBuffer,
    num_epochs: int = 2,
) -> None:
    """Makes an optimizer step along the sum of the ``loss_*`` outputs for each minibatch.

    Args:
        losses (callable): a loss module, or anything that returns losses for a minibatch.
        optimizer (torch.optim.Optimizer): the optimizer.
        buffer (ReplayBuffer): what the minibatches are drawn from.
        num_epochs (int, optional): passes over the buffer. Defaults to ``2``.

    Examples:
        >>> from torchrl_safe.objectives import PPOLagrangianLoss
        >>> from torchrl_safe.testing import make_batch, make_networks
        >>> loss = PPOLagrangianLoss(*make_networks())
        >>> buffer = ReplayBuffer(storage=LazyTensorStorage(100), batch_size=16)
        >>> data = loss.estimate_advantages(make_batch()).reshape(-1)
        >>> indices = buffer.extend(data)
        >>> before = loss.actor_network_params.detach().clone()
        >>> optimizer = torch.optim.SGD(loss.parameters(), lr=0.1)
        >>> run_epochs(loss, optimizer, [buffer.sample()], num_epochs=1)
        >>> bool((loss.actor_network_params != before).any())
        True
    """
    for _ in range(num_epochs):
        for minibatch in buffer:
            total(losses(minibatch)).backward()
            optimizer.step()
            optimizer.zero_grad()


def train_on_bandit(
    make_loss: Callable[..., LossModule],
    make_updater: Callable[..., Any] | None = None,
    *,
    num_batches: int = 80,
    num_costs: int = 2,
    lr: float = 0.1,
    seed: int = 0,
    learn: Callable[[LossModule, torch.optim.Optimizer, ReplayBuffer], None] = run_epochs,
    read: Callable[[LossModule], Tensor] | None = None,
) -> tuple[Tensor, Tensor]:
    """Trains an on-policy loss on :class:`ConstrainedBandit`.

    Args:
        make_loss (callable): called with actor, critic and cost critic, and with
            ``num_costs=num_costs``; returns a loss with ``estimate_advantages``.
        make_updater (callable, optional): called with the loss and ``cost_limit``, for example
            ``partial(DualAscent, lr=1.0)``. By default multipliers stay as they are.

    Keyword Args:
        num_batches (int, optional): batches of 512 episodes. Defaults to ``80``.
        num_costs (int, optional): ``2``, or ``1`` to leave out the cost that never binds.
        lr (float, optional): learning rate of gradient descent. Defaults to ``0.1``.
        seed (int, optional): seed of weights, actions and minibatches. Leaves the global generator
            as it was.
        learn (callable, optional): what is done with a batch, called with loss, optimizer and
            replay buffer. Defaults to two epochs in minibatches of 256.
        read (callable, optional): what to read from the loss after each batch.
            Defaults to its multipliers.

    Returns:
        For each batch the share of action A, shape (T,), and what ``read`` returned.

    Examples:
        >>> from functools import partial
        >>> from torchrl_safe.objectives import DualAscent, PPOLagrangianLoss
        >>> make_loss = partial(PPOLagrangianLoss, entropy_bonus=False)
        >>> make_updater = partial(DualAscent, lr=1.0)
        >>> shares, multipliers = train_on_bandit(make_loss, make_updater, num_batches=3)
        >>> shares.shape, multipliers.shape
        (torch.Size([3]), torch.Size([3, 2]))
    """
    with seeded(seed):
        env = ConstrainedBandit(num_costs)
        actor, critic, cost_critic = env.make_networks()
        loss = make_loss(actor, critic, cost_critic, num_costs=num_costs)
        updater = make_updater(loss, cost_limit=env.cost_limit) if make_updater else None
        optimizer = torch.optim.SGD(loss.parameters(), lr=lr)
        size = env.batch_size.numel()
        collector = Collector(
            env,
            actor,
            frames_per_batch=size,
            total_frames=num_batches * size,
            auto_register_policy_transforms=False,
        )
        buffer = ReplayBuffer(
            storage=LazyTensorStorage(size),
            sampler=SamplerWithoutReplacement(),
            batch_size=size // 2,
        )
        shares, readings = [], []
        for batch in collector:
            if updater is not None:
                # Every episode is one step long: its cost is the cost of the step.
                updater.step(batch["next", "cost"][batch["next", "done"].squeeze(-1)])
            buffer.extend(loss.estimate_advantages(batch).reshape(-1))
            learn(loss, optimizer, buffer)
            shares.append(batch["action"][..., 0].float().mean())
            readings.append((read(loss) if read else loss.lagrange_multiplier).clone())
        collector.shutdown()
    return torch.stack(shares), torch.stack(readings)


def check_reaches_optimum(
    make_loss: Callable[..., LossModule],
    make_updater: Callable[..., Any],
    *,
    num_batches: int = 80,
    probability_tolerance: float = 0.02,
    multiplier_tolerance: float = 0.1,
    learn: Callable[[LossModule, torch.optim.Optimizer, ReplayBuffer], None] = run_epochs,
) -> None:
    """Checks that an on-policy loss and a multiplier rule end at the optimum of a small problem.

    Trains on :class:`ConstrainedBandit` with two costs, of which one binds, and compares the
    means over the last half of the batches with the best policy and its multipliers. Takes a few
    seconds.

    Args:
        make_loss (callable): see :func:`train_on_bandit`. The loss has multipliers, no entropy
            bonus, and standardizes the reward advantage.
        make_updater (callable): see :func:`train_on_bandit`.

    Keyword Args:
        num_batches (int, optional): batches of 512 episodes. Defaults to ``80``.
        probability_tolerance (float, optional): allowed distance of the probability of action A
            from the best. A batch has a noise of 0.02. Defaults to ``0.02``.
        multiplier_tolerance (float, optional): allowed distance of the multiplier of the first
            cost. That of the second must be below 0.001. Defaults to ``0.1``.
        learn (callable, optional): see :func:`train_on_bandit`.

    Raises:
        AssertionError: if the policy or a multiplier ends elsewhere.

    Examples:
        >>> from functools import partial
        >>> from torchrl_safe.objectives import PIDControl, PPOLagrangianLoss
        >>> check_reaches_optimum(
        ...     partial(PPOLagrangianLoss, entropy_bonus=False),
        ...     partial(PIDControl, pessimism=0.0),
        ... )
    """
    shares, multipliers = train_on_bandit(
        make_loss, make_updater, num_batches=num_batches, learn=learn
    )
    share = shares[num_batches // 2 :].mean().item()
    binding, other = multipliers[num_batches // 2 :].mean(0).tolist()
    best, best_multiplier = (
        ConstrainedBandit.optimal_probability,
        ConstrainedBandit(num_envs=1).optimal_multiplier[0].item(),
    )
    for what, value, optimum, tolerance in (
        ("probability of action A", share, best, probability_tolerance),
        ("multiplier of the cost that binds", binding, best_multiplier, multiplier_tolerance),
        ("multiplier of the cost that does not bind", other, 0.0, 1e-3),
    ):
        require(
            abs(value - optimum) <= tolerance,
            f"The {what} is {value:.4f} after {num_batches} batches, the best is {optimum:.4f} "
            f"(within {tolerance}).",
        )
