"""A collector that can be saved and resumed exactly."""

from __future__ import annotations

import warnings
from collections import OrderedDict
from collections.abc import Mapping
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.collectors import Collector
from torchrl.envs import EnvBase, ParallelEnv, TransformedEnv


class ResumableCollector(Collector):
    """TorchRL's collector, with a state that is complete.

    The state of :class:`~torchrl.collectors.Collector` holds policy, transforms and counters, so a
    collector that loads it begins all episodes anew. This state also holds

    - the simulator's state,
    - the last observations, the running sums of :class:`~torchrl.envs.RewardSum`, and everything
      else that is carried from step to step,
    - the states of torch's generators, on the CPU and on each CUDA device in use.

    A collector that loads a state from between two batches collects what the saved one would have
    collected, bit for bit. The environment needs a complete ``state_dict``, as
    :class:`~torchrl_safe.envs.ArmEnv` has; any transforms may be around it. Episodes begin anew in
    environments whose state has no ``get_extra_state`` in it, in a
    :class:`~torchrl.envs.ParallelEnv`, and with ``trajs_per_batch``, where a batch leaves parts of
    trajectories behind that are not in the state. It also works in worker processes, as the
    ``collector_class`` of :class:`~torchrl.collectors.MultiSyncCollector` (trajectories may have
    other numbers there).

    After the last of ``total_frames`` a collector closes its environment, which then has no state.
    To save after the last batch, pass ``total_frames=-1`` and stop the loop yourself.

    Arguments are those of :class:`~torchrl.collectors.Collector`.

    Examples:
        >>> from tensordict.nn import TensorDictModule
        >>> from torchrl.envs import RewardSum, TransformedEnv
        >>> from torchrl_safe.envs import ArmEnv
        >>> def make():
        ...     env = TransformedEnv(ArmEnv(num_envs=2), RewardSum(["reward", "cost"]))
        ...     policy = TensorDictModule(torch.nn.LazyLinear(3), ["observation"], ["action"])
        ...     return ResumableCollector(
        ...         env, policy, frames_per_batch=20, total_frames=40,
        ...         auto_register_policy_transforms=False,
        ...     )
        >>> one, other = make(), make()
        >>> first, state = next(iter(one)), one.state_dict()
        >>> second = next(iter(one))
        >>> other.load_state_dict(state)
        >>> (next(iter(other)) == second).all()
        True
        >>> one.shutdown()
        >>> other.shutdown()
    """

    _carrier: TensorDictBase

    def state_dict(self) -> OrderedDict:
        """Returns the state between two batches."""
        state = super().state_dict()
        *around, env = _inner_envs(self.env)
        state.update({f"inner_env_{n}": level.state_dict() for n, level in enumerate(around)})
        # A ParallelEnv reads its first step after a load before it is there (TorchRL 0.14.1).
        goes_on = self.trajs_per_batch is None and not isinstance(env, ParallelEnv)
        if goes_on and _is_complete(simulator := env.state_dict()):
            state["base_env_state_dict"] = simulator
            state["carrier"] = self._carrier.exclude("next").clone().to_dict()
        # Tensors only: workers send their state as a TensorDict.
        state["torch_generator"] = torch.get_rng_state()
        if torch.cuda.is_initialized():
            state["cuda_generators"] = torch.stack(torch.cuda.get_rng_state_all())
        return state

    def load_state_dict(self, state_dict: OrderedDict, **kwargs: Any) -> None:
        """Loads a state that :meth:`state_dict` returned; that of a ``Collector`` as it does."""
        super().load_state_dict(state_dict, **kwargs)
        *around, env = _inner_envs(self.env)
        for n, level in enumerate(around):
            if f"inner_env_{n}" in state_dict:
                level.load_state_dict(state_dict[f"inner_env_{n}"])
        if "carrier" in state_dict:
            env.load_state_dict(state_dict["base_env_state_dict"])
            if "traj_pool" in state_dict:  # The pool of workers is in the state of their parent.
                # The method above has drawn numbers from it for trajectories that begin.
                self._traj_pool.load_state_dict(state_dict["traj_pool"])
            self._carrier = TensorDict(
                state_dict["carrier"],
                batch_size=self._carrier.batch_size,
                device=self._carrier.device,
            ).clone()
        elif "torch_generator" in state_dict:  # Not in the state of a Collector.
            warnings.warn(
                "Episodes begin anew, so the run differs from one that was not stopped. Only those "
                "of environments with get_extra_state go on, and not in a ParallelEnv or with "
                "trajs_per_batch.",
                stacklevel=2,
            )
        if "torch_generator" in state_dict:
            torch.set_rng_state(state_dict["torch_generator"].cpu())
        if "cuda_generators" in state_dict:
            # Those of the devices here: a run may be resumed with fewer.
            states = state_dict["cuda_generators"].cpu()[: torch.cuda.device_count()]
            torch.cuda.set_rng_state_all(list(states))


def _is_complete(state: Mapping[str, Any]) -> bool:
    """Whether it holds what ``get_extra_state`` gives; other environments save settings only."""
    return any(
        name.endswith("_extra_state") or (isinstance(part, Mapping) and _is_complete(part))
        for name, part in state.items()
    )


def _inner_envs(env: EnvBase) -> list[EnvBase]:
    """What the state of a ``Collector`` leaves out: the environments inside of the outermost."""
    inner = []
    while isinstance(env, TransformedEnv):
        env = env.base_env
        inner.append(env)
    return inner or [env]
