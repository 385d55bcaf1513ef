"""A cost among the observations becomes one beside the reward."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import NestedKey, TensorDictBase, unravel_key
from torchrl.data import Composite, Unbounded
from torchrl.envs import Transform


class CostToReward(Transform):
    """Moves costs from the observations of an environment to its rewards.

    TorchRL's ``SafetyGymnasiumEnv``, for example, reports its cost as an observation, shape ``()``
    and float64. ``RewardSum``, ``CostGAE`` and the losses read it as a reward, shape ``(1,)``
    and float32. After this transform ``reward_spec`` is
    ``Composite(reward=(*batch, 1), cost=(*batch, k))`` and neither the observations nor what
    ``reset`` returns have a cost.

    Args:
        in_keys (Sequence[NestedKey], optional): costs among the observations, of shape
            ``(*batch,)`` or ``(*batch, columns)`` and any real dtype. Their columns stand in
            this order. Defaults to ``("cost",)``.
        out_keys (Sequence[NestedKey], optional): the one key of the costs among the rewards,
            shape ``(*batch, k)``, float32. Defaults to ``("cost",)``.

    Raises:
        ValueError: if there is no ``in_key``, not one ``out_key``, or a cost of another shape.
        KeyError: if an ``in_key`` is not among the observations, or the ``out_key`` is already
            among the rewards.

    Examples:
        >>> from torchrl.envs import GymEnv, RenameTransform, TransformedEnv
        >>> pretend = RenameTransform(["observation"], ["cost"], create_copy=True)
        >>> env = TransformedEnv(GymEnv("Pendulum-v1"), pretend).append_transform(CostToReward())
        >>> env.rollout(5)["next", "cost"].shape
        torch.Size([5, 3])
        >>> list(env.reward_spec.keys()), list(env.observation_spec.keys())
        (['reward', 'cost'], ['observation'])
    """

    def __init__(
        self,
        in_keys: Sequence[NestedKey] = ("cost",),
        out_keys: Sequence[NestedKey] = ("cost",),
    ) -> None:
        if isinstance(in_keys, str) or not in_keys:
            raise ValueError(f"in_keys must be a sequence of at least one key, got {in_keys!r}.")
        if isinstance(out_keys, str) or len(out_keys) != 1:
            raise ValueError(
                f"out_keys must be a sequence of one key, such as [('costs', 'all')], got "
                f"{out_keys!r}."
            )
        super().__init__(
            in_keys=[unravel_key(key) for key in in_keys],
            out_keys=[unravel_key(key) for key in out_keys],
        )

    def transform_output_spec(self, output_spec: Composite) -> Composite:
        output_spec = output_spec.clone()
        observations = output_spec["full_observation_spec"]
        rewards = output_spec["full_reward_spec"]
        batch = observations.shape
        columns = 0
        for key in self.in_keys:
            if key not in (known := list(observations.keys(True, True))):
                raise KeyError(f"in_keys must be among the observations {known}, got {key!r}.")
            shape = observations[key].shape
            if not len(batch) <= len(shape) <= len(batch) + 1:
                raise ValueError(
                    f"cost {key!r} must have shape {(*batch,)} or {(*batch, 'columns')}, "
                    f"got {tuple(shape)}."
                )
            columns += shape[-1] if len(shape) > len(batch) else 1
            del observations[key]
            _remove_empty(observations, key)
        out_key = self.out_keys[0]
        if out_key in (known := list(rewards.keys(True, True))):
            raise KeyError(f"out_keys must not be among the rewards {known}, got {out_key!r}.")
        rewards[out_key] = Unbounded(
            (*batch, columns), dtype=torch.float32, device=output_spec.device
        )
        return output_spec

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        dims = next_tensordict.batch_dims
        costs = [next_tensordict.get(key).to(torch.float32) for key in self.in_keys]
        columns = [cost if cost.ndim > dims else cost.unsqueeze(-1) for cost in costs]
        return self._without_costs(next_tensordict).set(
            self.out_keys[0], torch.cat(columns, dim=-1)
        )

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        return self._without_costs(tensordict_reset)

    def _without_costs(self, tensordict: TensorDictBase) -> TensorDictBase:
        tensordict = tensordict.exclude(*self.in_keys)
        for key in self.in_keys:
            _remove_empty(tensordict, key)
        return tensordict

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        raise RuntimeError("CostToReward changes what an environment returns: append it to one.")


def _remove_empty(groups: Composite | TensorDictBase, key: NestedKey) -> None:
    """Removes the groups that a removed key leaves empty, in place."""
    for depth in range(len(key) - 1, 0, -1) if isinstance(key, tuple) else ():
        if key[:depth] in groups.keys(True) and groups[key[:depth]].is_empty():
            del groups[key[:depth]]
