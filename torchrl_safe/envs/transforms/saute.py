"""Safety augmentation of the state: the remaining budget of each cost."""

from __future__ import annotations

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor

from torchrl_safe._checks import as_number, check_array
from torchrl_safe.envs.transforms.budget import ROUNDING, CostTally


class Saute(CostTally):
    r"""Shows the remaining safety budget, and replaces the reward once it is exceeded.

    Presented in "Saute RL: Almost Surely Safe Reinforcement Learning Using State Augmentation",
    Sootla et al. 2022, https://arxiv.org/abs/2202.06558. The safety state of each cost, the share
    of its budget d that is left, is an observation:

    .. math::
        z_0 = 1, \qquad z_{t+1} = \frac{z_t - c_t / d}{\gamma_c},

    which stays at or above 0 if and only if the discounted cost stays at or below d. In each step
    that leaves it below 0 for any of the k costs, the reward is ``unsafe_reward``. Any algorithm
    without constraints then learns to keep to the budget in every episode, not only on average.
    A budget that is exactly used up is not exceeded here; in the authors' code it is.

    The policy has to see the safety state: join it to its observation with
    :class:`~torchrl.envs.CatTensors`, ``del_keys=False``, as below. Costs, termination and
    truncation stay as they are. A :class:`~torchrl.envs.RewardSum` before this transform sums
    the rewards of the task, one after it those that the agent learns from.

    Args:
        budget (float or Tensor): d, the limit of the discounted cost of an episode, one number
            or one for each of the k costs, above 0.

    Keyword Args:
        unsafe_reward (float): reward of a step that exceeds the budget or goes on beyond it.
            It must be below what a step can earn otherwise, or exceeding the budget pays.
        discount (float, optional): :math:`\gamma_c`, above 0 and at most 1. Defaults to ``1.0``:
            the budget is then a limit of the undiscounted episode cost, like ``cost_limit`` of
            :class:`~torchrl_safe.objectives.MultiplierUpdater`. (The authors' code turns a limit D
            on T steps into the budget :math:`D (1 - \gamma_c^T) / (T (1 - \gamma_c))`.) Below 1,
            the state of an episode without costs grows as :math:`\gamma_c^{-t}`: at 0.99 to 152
            in 500 steps. At 0.9 it is infinite after 843.
        cost_key (NestedKey, optional): the costs, among the rewards, shape ``(*batch, k)``.
            Defaults to ``"cost"``.
        reward_key (NestedKey, optional): the reward that is replaced. Defaults to ``"reward"``.
        out_key (NestedKey, optional): the safety state, shape ``(*batch, k)``.
            Defaults to ``"remaining_budget"``. The next step reads it, so no later transform may
            change it. One that does raises an error, unless it is outside a
            :class:`~torchrl.envs.ParallelEnv`, where this transform cannot see it.

    Raises:
        ValueError: if ``budget``, ``unsafe_reward`` or ``discount`` is not usable, or a later
            transform writes ``out_key``: have it write another key.
        KeyError: if the costs or the reward are not among the rewards, or ``out_key`` is already
            among the observations; in a step, if another transform has removed ``out_key``.

    Examples:
        >>> from torchrl.envs import CatTensors, Compose, GymEnv, RenameTransform, TransformedEnv
        >>> from torchrl_safe.envs import CostToReward
        >>> pretend = RenameTransform(["observation"], ["cost"], create_copy=True)
        >>> env = TransformedEnv(
        ...     GymEnv("Pendulum-v1"),
        ...     Compose(
        ...         pretend,
        ...         CostToReward(),
        ...         Saute(10.0, unsafe_reward=-20.0),
        ...         CatTensors(["observation", "remaining_budget"], "augmented", del_keys=False),
        ...     ),
        ... )
        >>> env.reset()["remaining_budget"]
        tensor([1., 1., 1.])
        >>> env.rollout(5)["augmented"].shape
        torch.Size([5, 6])
    """

    def __init__(
        self,
        budget: float | Tensor,
        *,
        unsafe_reward: float,
        discount: float = 1.0,
        cost_key: NestedKey = "cost",
        reward_key: NestedKey = "reward",
        out_key: NestedKey = "remaining_budget",
    ) -> None:
        super().__init__(
            budget, start=1.0, cost_key=cost_key, reward_key=reward_key, out_key=out_key
        )
        if not (self.budget > 0).all():
            raise ValueError(f"budget must be above 0, got {budget}.")
        if not 0 < as_number(discount) <= 1:
            raise ValueError(f"discount must be above 0 and at most 1, got {discount!r}.")
        self.unsafe_reward: float = float(check_array("unsafe_reward", unsafe_reward, ()))
        self.discount: float = discount

    def advance(self, tally: Tensor, cost: Tensor) -> Tensor:
        left = tally - cost / self.budget.to(tally)
        # A budget that is used up but for rounding stays so: the division would make it grow.
        return torch.where(left.abs() < ROUNDING, left, left / self.discount)

    def is_spent(self, tally: Tensor) -> Tensor:
        return tally < -ROUNDING

    def enforce(self, next_tensordict: TensorDictBase, spent: Tensor) -> TensorDictBase:
        reward = next_tensordict.get(self.reward_key)
        return next_tensordict.set(self.reward_key, torch.where(spent, self.unsafe_reward, reward))
