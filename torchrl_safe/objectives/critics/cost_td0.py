"""One-step temporal differences for several costs at once."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor
from torchrl.objectives.value import TD0Estimator

from torchrl_safe.objectives._checks import check_number, get_or_raise, refuse_options


class CostTD0(TD0Estimator):
    r"""TD(0) of k costs, each with its own column, sharing one done signal.

    .. math::
        y_i = c_i + \gamma \, (1 - \mathrm{terminated}) \, Q_{c_i}(s', a')

    This class is a thin specialization of :class:`~torchrl.objectives.value.TD0Estimator`. It
    reads ``("next", "cost")`` and ``("next", "state_action_cost_value")``, both of shape
    ``(*B, k)``; ``terminated`` keeps its shape ``(*B, 1)`` and is broadcast over the k costs. A
    truncated episode bootstraps from its last observation, a terminated one does not. After a
    :class:`~torchrl.envs.MultiStepTransform` that sums the cost too (``reward_keys=["reward",
    "cost"]``, with one ``gamma`` for both), the power of ``gamma`` is ``"steps_to_next_obs"``.

    Keyword Args:
        gamma (float): discount of the costs, from 0 to 1.
        value_network (TensorDictModule, optional): cost critic with k outputs. Defaults to
            ``None``, which expects ``("next", "state_action_cost_value")`` in the data.
        **kwargs: the other arguments of :class:`~torchrl.objectives.value.TD0Estimator`.

    Raises:
        ValueError: if ``gamma`` is out of its range; in a call, if the cost and the value of a
            batch differ in shape.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> following = TensorDict(
        ...     cost=torch.tensor([[1.0, 0.0], [1.0, 0.0]]),
        ...     state_action_cost_value=torch.tensor([[2.0, 4.0], [2.0, 4.0]]),
        ...     done=torch.tensor([[True], [True]]),
        ...     terminated=torch.tensor([[False], [True]]),
        ...     batch_size=[2],
        ... )
        >>> batch = TensorDict(next=following, batch_size=[2])
        >>> CostTD0(gamma=0.5).value_estimate(batch)
        tensor([[2., 2.],
                [1., 0.]])
    """

    @dataclass
    class _AcceptedKeys(TD0Estimator._AcceptedKeys):
        # All of them are declared again: set_keys looks at the class's own names only.
        advantage: NestedKey = "cost_advantage"
        value_target: NestedKey = "cost_value_target"
        value: NestedKey = "state_action_cost_value"
        reward: NestedKey = "cost"
        done: NestedKey = "done"
        terminated: NestedKey = "terminated"
        steps_to_next_obs: NestedKey = "steps_to_next_obs"
        sample_log_prob: NestedKey | None = None

    default_keys = _AcceptedKeys

    def __init__(
        self, *, gamma: float, value_network: TensorDictModuleBase | None = None, **kwargs: Any
    ) -> None:
        reason = "costs keep their unit, in which their limits are"
        refuse_options("CostTD0", kwargs, "average_rewards", "group_key", reason=reason)
        super().__init__(
            gamma=check_number("gamma", gamma, most=1), value_network=value_network, **kwargs
        )

    def value_estimate(
        self,
        tensordict: TensorDictBase,
        target_params: TensorDictBase | None = None,
        next_value: Tensor | None = None,
        **kwargs: Any,
    ) -> Tensor:
        keys = self.tensor_keys
        if next_value is None:
            # Of the base: what the value network says of the next step.
            next_value = self._next_value(tensordict, target_params, kwargs=kwargs)
        cost = get_or_raise(tensordict, unravel_key(("next", keys.reward)))
        if cost.shape != next_value.shape:
            raise ValueError(
                f"The cost {keys.reward!r} and its value {keys.value!r} must have one column for "
                f"each constraint, got shapes {tuple(cost.shape)} and {tuple(next_value.shape)}."
            )
        tensordict = tensordict.clone(False)
        for key in (
            unravel_key(("next", keys.done)),
            unravel_key(("next", keys.terminated)),
            keys.steps_to_next_obs,
        ):
            signal = tensordict.get(key, None)
            if signal is not None:
                # MultiStepTransform counts its steps without a last dimension.
                signal = signal.reshape(*cost.shape[:-1], 1)
                tensordict.set(key, signal.expand_as(cost))
        return super().value_estimate(tensordict, next_value=next_value, **kwargs)
