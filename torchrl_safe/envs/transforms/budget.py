"""What transforms with a safety budget share: a tally of the costs of an episode."""

from __future__ import annotations

import abc

import torch
from tensordict import NestedKey, TensorDictBase, unravel_key
from torch import Tensor
from torchrl.data import Composite, TensorSpec, Unbounded
from torchrl.envs import DTypeCastTransform, Transform

from torchrl_safe._checks import as_tensor, check_one_each

# In units of the budget: one that is used up to the last digit is not exceeded by rounding.
ROUNDING = 1e-4


class CostTally(Transform, abc.ABC):
    """Keeps one number for each of k costs from step to step, as an observation of its own.

    The number lives in the tensordict, as the sums of :class:`~torchrl.envs.RewardSum` do: a
    partial reset starts it anew in the rows that it resets, and in those only, in batched and in
    parallel environments.

    Args:
        budget (float or Tensor): what the costs of an episode may sum up to, one number or k.
        start (float): the number that an episode begins with.
        cost_key (NestedKey): the costs, among the rewards, shape ``(*batch, k)``.
        reward_key (NestedKey): the reward that changes, shape ``(*batch, 1)``.
        out_key (NestedKey): where the number is written, shape ``(*batch, k)``.
    """

    budget: Tensor

    def __init__(
        self,
        budget: float | Tensor,
        *,
        start: float,
        cost_key: NestedKey,
        reward_key: NestedKey,
        out_key: NestedKey,
    ) -> None:
        limit = as_tensor("budget", budget, torch.get_default_dtype())
        if limit.ndim > 1 or not limit.isfinite().all() or (limit < 0).any():
            raise ValueError(
                "budget must be one number or one for each cost, finite and not negative, got "
                f"{budget}."
            )
        self.cost_key, self.reward_key, self.out_key = map(
            unravel_key, (cost_key, reward_key, out_key)
        )
        super().__init__(in_keys=[self.cost_key], out_keys=[self.out_key])
        self.start = start
        self.register_buffer("budget", limit.clone())

    @abc.abstractmethod
    def advance(self, tally: Tensor, cost: Tensor) -> Tensor:
        """Returns the number after a step with a cost; all of shape ``(*batch, k)``."""

    @abc.abstractmethod
    def is_spent(self, tally: Tensor) -> Tensor:
        """Tells where a budget is exceeded; both of shape ``(*batch, k)``."""

    @abc.abstractmethod
    def enforce(self, next_tensordict: TensorDictBase, spent: Tensor) -> TensorDictBase:
        """Changes what a step returns where any budget is exceeded, ``spent`` ``(*batch, 1)``."""

    def _tally_spec(self, rewards: Composite) -> TensorSpec:
        known = list(rewards.keys(True, True))
        for name, key in (("cost_key", self.cost_key), ("reward_key", self.reward_key)):
            if key not in known:
                raise KeyError(f"{name} must be among the rewards {known}, got {key!r}.")
        spec = rewards[self.cost_key]
        check_one_each("budget", self.budget, spec.shape[-1])
        check_column("reward_key", self.reward_key, rewards[self.reward_key], spec)
        if not (dtype := rewards[self.reward_key].dtype).is_floating_point:
            raise ValueError(
                f"reward_key must be of floating-point numbers, got {dtype} for "
                f"{self.reward_key!r}: a penalty of -0.5 would be 0."
            )
        dtype = spec.dtype if spec.dtype.is_floating_point else torch.get_default_dtype()
        return Unbounded(spec.shape, dtype=dtype, device=spec.device)

    def transform_output_spec(self, output_spec: Composite) -> Composite:
        output_spec = output_spec.clone()
        observations = output_spec["full_observation_spec"]
        if self.out_key in (known := list(observations.keys(True, True))):
            raise KeyError(
                f"out_key must not be among the observations {known}, got {self.out_key!r}."
            )
        ends = [_folder(key) for key in output_spec["full_done_spec"].keys(True, True)]
        if not any(_folder(self.out_key)[: len(end)] == end for end in ends):
            raise KeyError(
                f"out_key must stand beside done flags, which are in {sorted({*ends})}, got "
                f"{self.out_key!r}: a reset would not begin it anew."
            )
        self._add_tally(observations, output_spec["full_reward_spec"])
        return output_spec

    def transform_input_spec(self, input_spec: Composite) -> Composite:
        self._refuse_changes()
        # Batched environments hand their workers the entries that are in the state alone.
        input_spec = input_spec.clone()
        states = input_spec["full_state_spec"]
        if states is None:
            states = Composite(shape=input_spec.shape, device=input_spec.device)
        self._add_tally(states, self.parent.full_reward_spec)
        input_spec["full_state_spec"] = states
        return input_spec

    def _refuse_changes(self) -> None:
        """Raises if a later transform would change the tally that the next step starts from."""
        transforms = [m for m in self.container.transform.modules() if isinstance(m, Transform)]
        for other in reversed(transforms):
            if other is self:
                return
            changes = self.out_key in (other.out_keys or ())
            if changes and not isinstance(other, DTypeCastTransform):
                raise ValueError(
                    f"out_key must not be written by a later transform, got {self.out_key!r} and "
                    f"{type(other).__name__}: the next step would start from what it has made of "
                    "it. Give that transform other out_keys."
                )

    def _add_tally(self, specs: Composite, rewards: Composite) -> None:
        spec, folder = self._tally_spec(rewards), _folder(self.out_key)
        for depth in range(1, len(folder) + 1):  # A new group would not get the batch of agents.
            if (key := folder[:depth]) not in specs.keys(True) and key in rewards.keys(True):
                specs[key] = Composite(shape=rewards[key].shape, device=spec.device)
        specs[self.out_key] = spec

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        reset, tally = self._reset_mask(tensordict), tensordict.get(self.out_key, None)
        if tally is None:  # All rows begin then.
            tally = self._tally_spec(self.parent.full_reward_spec).zero() + self.start
        elif reset is None:
            tally = torch.full_like(tally, self.start)
        else:
            # A mask has the batch of the environment, of its agents, or a last dimension of 1.
            reset = reset.reshape(*reset.shape, *(1,) * (tally.ndim - reset.ndim))
            tally = torch.where(reset, self.start, tally)
        return tensordict_reset.set(self.out_key, tally)

    def _reset_mask(self, tensordict: TensorDictBase) -> Tensor | None:
        """The mask that stands nearest to the tally: agents may have one of their own."""
        folder = _folder(self.out_key)
        for depth in range(len(folder), -1, -1):
            mask = tensordict.get((*folder[:depth], "_reset"), None)
            if mask is not None:
                return mask
        return None

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        before = tensordict.get(self.out_key, None)
        if before is None:
            raise KeyError(
                f"{self.out_key!r} must come from the step before, and is missing: a transform "
                "that uses it must keep it (CatTensors with del_keys=False)."
            )
        cost = next_tensordict.get(self.cost_key).to(before)
        if cost.isnan().any():  # No tally that is NaN ever exceeds a budget.
            raise ValueError(f"{self.cost_key!r} must be numbers, got NaN: {cost}.")
        tally = self.advance(before, cost)
        next_tensordict.set(self.out_key, tally)
        return self.enforce(next_tensordict, self.is_spent(tally).any(-1, keepdim=True))

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        raise RuntimeError(
            f"{type(self).__name__} changes what an environment returns: append it to one."
        )


def check_column(name: str, key: NestedKey, spec: TensorSpec, costs: TensorSpec) -> None:
    """Raises ValueError unless there is one number for each row of costs."""
    if spec.shape != (shape := (*costs.shape[:-1], 1)):
        raise ValueError(
            f"{name} must have shape {tuple(shape)}, since the costs have {tuple(costs.shape)}, "
            f"got {tuple(spec.shape)} for {key!r}."
        )


def _folder(key: NestedKey) -> tuple[str, ...]:
    return () if isinstance(key, str) else tuple(key[:-1])
