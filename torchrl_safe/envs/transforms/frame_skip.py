"""Repeated actions in environments with costs."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import TensorSpec
from torchrl.envs import FrameSkipTransform

from torchrl_safe._checks import check_count


class FrameSkip(FrameSkipTransform):
    """Repeats each action, and sums every reward of the environment, so costs too.

    Use it where TorchRL's :class:`~torchrl.envs.FrameSkipTransform` raises a KeyError: in
    environments with more than one reward. TorchRL's also steps on after an episode has ended. Here
    a row keeps its first ``done`` and what came with it, and later steps do not count.
    :class:`~torchrl_safe.envs.ArmEnv` needs neither: its own ``frame_skip`` is faster.

    Rows that have ended are stepped until all have, which Gymnasium's vectorized environments do
    not allow: put single ones in a :class:`~torchrl.envs.SerialEnv`, each with its own FrameSkip.

    Args:
        frame_skip (int, optional): how often an action is taken. Defaults to ``1``.

    Raises:
        ValueError: if ``frame_skip`` is not a whole number of at least 1, or, when appended, if a
            reward of the environment is a flag.

    Examples:
        >>> from torchrl.envs import TransformedEnv
        >>> from torchrl_safe.envs import ArmEnv
        >>> env = TransformedEnv(ArmEnv(num_envs=2), FrameSkip(4))
        >>> def rest(td):
        ...     return td.update(env.full_action_spec.zero())
        >>> rollout = env.rollout(20, rest)  # The time is up after 40 steps.
        >>> rollout.shape, rollout["next", "truncated"].sum(1).flatten().tolist()
        (torch.Size([2, 10]), [1, 1])
        >>> env.close()
    """

    def __init__(self, frame_skip: int = 1) -> None:
        check_count(frame_skip=frame_skip)
        super().__init__(frame_skip)

    def transform_reward_spec(self, reward_spec: TensorSpec) -> TensorSpec:
        for key, spec in reward_spec.items(True, True):
            if spec.dtype is torch.bool:
                raise ValueError(f"{key} must be a number to be summed, got {spec.dtype}.")
        return reward_spec

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        # Earlier transforms change the action after this one, and do so in each frame anew.
        self._asked = tensordict.copy()
        return tensordict

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        if (parent := self.parent) is None:
            raise RuntimeError("FrameSkip repeats the steps of an environment: append it to one.")
        asked = self._asked.select(*parent.action_keys)
        for _ in range(self.frame_skip - 1):
            over = _is_over(next_tensordict)
            if over.all():
                break
            # Sums, budgets and counters of earlier transforms go on from the step before.
            before = tensordict.copy().update(next_tensordict.exclude(*parent.reward_keys))
            after = parent._step(before.update(asked))
            for key in parent.reward_keys:
                after.set(key, next_tensordict.get(key) + after.get(key))
            next_tensordict = next_tensordict.where(over, after)
        return next_tensordict


def _is_over(tensordict: TensorDictBase) -> Tensor:
    """Which of the environments have ended their episode, of the tensordict's shape."""
    flags = [tensordict.get(key, None) for key in ("done", "terminated", "truncated")]
    ends = [flag.reshape(tensordict.shape) for flag in flags if flag is not None]
    if not ends:
        raise KeyError("FrameSkip needs 'done' of the whole environment, not of its agents.")
    return torch.stack(ends).any(0)
