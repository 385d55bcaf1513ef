"""Termination of an episode that has cost too much."""

from __future__ import annotations

import torch
from tensordict import NestedKey, TensorDictBase, unravel_key
from torch import Tensor
from torchrl.data import Composite

from torchrl_safe._checks import check_array
from torchrl_safe.envs.transforms.budget import ROUNDING, CostTally, check_column


class EarlyTermination(CostTally):
    r"""Terminates an episode once the sum of a cost exceeds its budget.

    Presented in "Safe Exploration by Solving Early Terminated MDP", Sun et al. 2021,
    https://arxiv.org/abs/2107.04200: with a terminal state that is worth little enough, the best
    policy of the terminated problem is the best that keeps to the budget in every episode, and
    any algorithm without constraints can look for it. The episode ends with the step that
    exceeds the budget: ``terminated`` and ``done`` become true there. In all other steps, and
    ``truncated`` always, they are as the environment returns them.

    Value estimators give what follows a termination the value 0. That is right for a task with
    positive rewards. With negative ones it pays to end the episode, so pass a
    ``termination_reward`` below anything that the rest of an episode can earn.

    The sum of each cost so far is an observation of its own, since the remaining budget is part of
    the state. Join it to what the policy sees with :class:`~torchrl.envs.CatTensors`,
    ``del_keys=False``, or leave it out if the budget is 0. A :class:`~torchrl.envs.RewardSum`
    before this transform sums rewards without ``termination_reward``, one after it with.

    An environment whose episode ends early is reset alone. Gymnasium's vectorized environments,
    such as ``GymEnv(name, num_envs=4)``, refuse that. :class:`~torchrl.envs.SerialEnv` does not,
    nor does :class:`~torchrl_safe.envs.gym.SafeGymEnv` with Gymnasium 1.1 or later.

    Args:
        budget (float or Tensor): limit of the undiscounted cost of an episode, one number or one
            for each of the k costs, at least 0. The first excess of any of them ends the episode.

    Keyword Args:
        termination_reward (float, optional): added to the reward of the step that ends the
            episode, and of each that an agent takes after its own end. Defaults to ``0.0``.
        cost_key (NestedKey, optional): the costs, among the rewards, shape ``(*batch, k)``.
            Defaults to ``"cost"``.
        reward_key (NestedKey, optional): the reward. Defaults to ``"reward"``.
        out_key (NestedKey, optional): the sums so far, shape ``(*batch, k)``.
            Defaults to ``"accumulated_cost"``. The next step reads them, so no later transform may
            change them. One that does raises an error, unless it is outside a
            :class:`~torchrl.envs.ParallelEnv`, where this transform cannot see it.
        terminated_key (NestedKey, optional): Defaults to ``"terminated"``.
        done_key (NestedKey, optional): Defaults to ``"done"``.

    Raises:
        ValueError: if ``budget`` or ``termination_reward`` is not usable, or a later transform
            writes ``out_key``: have it write another key.
        KeyError: if costs, reward or done flags are not what the environment returns, or
            ``out_key`` is already among the observations; in a step, if another transform has
            removed ``out_key``.

    Examples:
        >>> from torchrl.envs import Compose, GymEnv, RenameTransform, TransformedEnv
        >>> from torchrl_safe.envs import CostToReward
        >>> pretend = RenameTransform(["observation"], ["cost"], create_copy=True)
        >>> early = EarlyTermination(0.5, termination_reward=-100.0)
        >>> env = TransformedEnv(GymEnv("Pendulum-v1"), Compose(pretend, CostToReward(), early))
        >>> rollout = env.rollout(200)
        >>> rollout["next", "terminated"][-1], (rollout["next", "accumulated_cost"][-1] > 0.5).any()
        (tensor([True]), tensor(True))
    """

    def __init__(
        self,
        budget: float | Tensor,
        *,
        termination_reward: float = 0.0,
        cost_key: NestedKey = "cost",
        reward_key: NestedKey = "reward",
        out_key: NestedKey = "accumulated_cost",
        terminated_key: NestedKey = "terminated",
        done_key: NestedKey = "done",
    ) -> None:
        super().__init__(
            budget, start=0.0, cost_key=cost_key, reward_key=reward_key, out_key=out_key
        )
        self.termination_reward = float(check_array("termination_reward", termination_reward, ()))
        self.terminated_key, self.done_key = unravel_key(terminated_key), unravel_key(done_key)

    def transform_output_spec(self, output_spec: Composite) -> Composite:
        flags, rewards = output_spec["full_done_spec"], output_spec["full_reward_spec"]
        transformed = super().transform_output_spec(output_spec)
        known = list(flags.keys(True, True))
        for name, key in (("terminated_key", self.terminated_key), ("done_key", self.done_key)):
            if key not in known:
                raise KeyError(f"{name} must be among the done flags {known}, got {key!r}.")
            check_column(name, key, flags[key], rewards[self.cost_key])
        return transformed

    def advance(self, tally: Tensor, cost: Tensor) -> Tensor:
        return tally + cost

    def is_spent(self, tally: Tensor) -> Tensor:
        return tally > (1 + ROUNDING) * self.budget.to(tally)

    def enforce(self, next_tensordict: TensorDictBase, spent: Tensor) -> TensorDictBase:
        reward = next_tensordict.get(self.reward_key)
        reward = torch.where(spent, reward + self.termination_reward, reward)
        next_tensordict.set(self.reward_key, reward)
        for key in (self.terminated_key, self.done_key):
            next_tensordict.set(key, next_tensordict.get(key) | spent)
        return next_tensordict
