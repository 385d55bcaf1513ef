"""Plays whole episodes with a policy, and puts confidence intervals on what they show.

Needs SciPy: ``pip install "torchrl-safe[metrics]"``.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

import torch
from tensordict import TensorDict, TensorDictBase, unravel_key
from tensordict.nn import TensorDictModuleBase
from torch import nn
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type

from torchrl_safe._checks import check_count, check_kind, check_names
from torchrl_safe.metrics import mean, share, violation_rate

__all__ = ["evaluate", "summarize"]


@torch.no_grad()
def evaluate(
    env: EnvBase,
    policy: Callable[[TensorDictBase], TensorDictBase],
    episodes: int,
    *,
    seed: int,
    max_steps: int = 10_000,
    exploration_type: ExplorationType = ExplorationType.DETERMINISTIC,
) -> TensorDict:
    """Plays episodes, by default with the deterministic policy.

    Each environment of a batch plays whole episodes, one after the other. (TorchRL's ``Evaluator``
    takes the first episodes that end, which are the short ones.)

    Args:
        env (EnvBase): environment, batched or not, with a ``reward`` and a ``cost``. A cost that
            is an observation becomes one with :class:`~torchrl_safe.envs.CostToReward`.
            Running statistics in it change while it plays: freeze them first
            (:meth:`VecNormV2.freeze <torchrl.envs.VecNormV2.freeze>`).
        policy (callable): the policy: the actor that you train, or ``load_policy(...).actor``. A
            module plays in evaluation mode, and is then put back into the mode it was in.
        episodes (int): how many episodes to play at least. A batch of environments plays all the
            episodes that it begins.

    Keyword Args:
        seed (int): seed of the episodes. With the same seed every policy meets the same episodes.
        max_steps (int, optional): steps in which every episode must end. Defaults to ``10_000``.
        exploration_type (ExplorationType, optional): how actions are drawn.
            ``ExplorationType.RANDOM`` plays the policy with its noise, as it was trained; that can
            cost much less, or more. The noise is PyTorch's: ``seed`` does not set it, call
            :func:`torch.manual_seed`. Defaults to ``ExplorationType.DETERMINISTIC``.

    Returns:
        A TensorDict of shape ``(E,)`` with, for each episode, ``episode_reward`` of shape
        ``(E, 1)``, ``episode_cost`` ``(E, k)``, ``steps`` ``(E, 1)``, and ``success`` ``(E, 1)`` if
        the environment has it. The sums are the environment's own if it has ``episode_reward``
        or ``episode_cost`` (:class:`~torchrl.envs.RewardSum`). If its own keys are nested, append
        ``RewardSum([("agent", "reward"), ("agent", "cost")], ["episode_reward", "episode_cost"])``.

    Raises:
        TypeError: if ``env`` is no environment, ``policy`` cannot be called, or
            ``exploration_type`` is none.
        ValueError: if the environment has no cost, reward or ``done``, it has no key for the state
            of a recurrent policy, or an episode has not ended after ``max_steps``.

    Examples:
        >>> from torchrl.envs.utils import RandomPolicy
        >>> from torchrl_safe.envs import ArmEnv
        >>> env = ArmEnv(num_envs=2, max_episode_steps=3)
        >>> episodes = evaluate(env, RandomPolicy(env.action_spec), 4, seed=0)
        >>> episodes["steps"].squeeze(-1)
        tensor([3, 3, 3, 3])
        >>> figures = summarize(episodes, env.cost_names)
        >>> list(figures)
        ['success', 'return', 'steps', 'cost/collision', 'any/collision']
    """
    check_kind("env", env, EnvBase)
    if not callable(policy):
        raise TypeError(f"policy must be callable, got {policy!r}.")
    check_count(episodes=episodes, max_steps=max_steps)
    check_kind("exploration_type", exploration_type, ExplorationType)
    specs = {**env.full_observation_spec, **env.full_reward_spec}
    for name in ("reward", "cost"):
        spec = specs.get(f"episode_{name}", specs.get(name))
        if spec is None:
            raise ValueError(
                f"env must have the key {name!r} or 'episode_{name}', got {[*specs]}: with nested "
                "keys, RewardSum can write the second."
            )
        if len(spec.shape) != env.ndim + 1:
            raise ValueError(
                f"{name} must have shape (*{tuple(env.shape)}, k), got {tuple(spec.shape)}: "
                "CostToReward makes a cost of an observation."
            )
        if f"episode_{name}" in specs and spec.dtype == torch.bool:
            raise ValueError(
                f"episode_{name} must be numbers, got {spec.dtype}: make the environment's {name} "
                "a float, a sum of flags is a flag."
            )
    flags = [*env.full_done_spec.keys(True, True)]
    if "done" not in flags:
        raise ValueError(f"env must have the key 'done', got {flags}.")
    rounds = []
    with set_exploration_type(exploration_type), _in_evaluation_mode(policy):
        for _ in range(math.ceil(episodes / env.batch_size.numel())):
            seed = env.set_seed(seed)
            rounds.append(_play(env, policy, max_steps))
    return torch.cat(rounds)


def summarize(
    episodes: TensorDictBase, cost_names: Sequence[str] | None = None
) -> dict[str, list[float]]:
    """Returns each figure of the episodes with the ends of its 95 % confidence interval.

    The figures are ``return``, ``steps``, ``success``, and for each cost its mean (``cost/name``)
    and the share of episodes with any of it (``any/name``). Shares have Wilson's interval, means
    that of the percentile bootstrap.

    Args:
        episodes (TensorDictBase): what :func:`evaluate` returns.
        cost_names (sequence of str, optional): names of the costs, such as ``env.cost_names``.
            Defaults to their numbers.

    Returns:
        Estimate, lower and upper end, by name of the figure.

    Raises:
        ValueError: if there is not a different name for each cost, ``success`` is not bool, or
            there are fewer than two episodes, which have no interval.

    Examples:
        >>> episodes = TensorDict(
        ...     episode_reward=torch.tensor([[1.0], [3.0]]),
        ...     episode_cost=torch.tensor([[0.0], [2.0]]),
        ...     steps=torch.tensor([[10], [20]]),
        ...     batch_size=[2],
        ... )
        >>> figures = summarize(episodes, ["collision"])
        >>> [figures[name][0] for name in ("return", "steps", "cost/collision", "any/collision")]
        [2.0, 15.0, 1.0, 0.5]
    """
    costs = episodes["episode_cost"]
    names = check_names(cost_names, costs.shape[-1])
    success = episodes.get("success", None)
    if success is not None and success.dtype != torch.bool:
        raise ValueError(f"success must be True or False, got {success.dtype}.")
    estimates = {} if success is None else {"success": share(success)}
    estimates["return"] = mean(episodes["episode_reward"])
    estimates["steps"] = mean(episodes["steps"])
    for name, column in zip(names, costs.split(1, -1), strict=True):
        estimates[f"cost/{name}"] = mean(column)
        estimates[f"any/{name}"] = violation_rate(column, 0.0)
    return {name: torch.cat(estimate).tolist() for name, estimate in estimates.items()}


@contextmanager
def _in_evaluation_mode(policy: object) -> Iterator[None]:
    """Dropout and batch norm behave as in the file that ``save_policy`` writes."""
    modules = policy.modules() if isinstance(policy, nn.Module) else ()
    training = [module for module in modules if module.training]
    for module in training:
        module.training = False
    try:
        yield
    finally:
        for module in training:
            module.training = True


def _play(
    env: EnvBase, policy: Callable[[TensorDictBase], TensorDictBase], max_steps: int
) -> TensorDictBase:
    """One episode in each environment of a batch, until the last of them has ended."""
    tensordict = env.reset()
    _check_memory(policy, tensordict)
    running = torch.ones(env.batch_size, dtype=torch.bool, device=env.device)
    figures: TensorDictBase | None = None
    for step in range(1, max_steps + 1):
        played, tensordict = env.step_and_maybe_reset(policy(tensordict))
        current = _figures(played["next"], figures)
        current["steps"] = torch.full((*env.batch_size, 1), step, device=env.device)
        figures = current if figures is None else current.where(running, figures)
        running &= ~played["next", "done"].squeeze(-1)
        if not running.any():
            return figures.reshape(-1)
    raise ValueError(
        f"max_steps must let every episode end, got {max_steps}, after which "
        f"{int(running.sum())} of {running.numel()} go on."
    )


def _check_memory(policy: object, start: TensorDictBase) -> None:
    """Raises ValueError for a recurrent policy whose state would be dropped after each step."""
    if not isinstance(policy, TensorDictModuleBase):
        return
    states = [key for key in policy.in_keys if unravel_key(("next", key)) in policy.out_keys]
    if lost := [key for key in states if start.get(key, None) is None]:
        raise ValueError(
            f"env must have the keys {lost}, the state of a recurrent policy: append the module's "
            "make_tensordict_primer()."
        )


def _figures(after: TensorDictBase, before: TensorDictBase | None) -> TensorDictBase:
    """Sums of reward and cost up to a step, and whether it was a success."""
    figures = after.select("success", "episode_reward", "episode_cost", strict=False).clone()
    for name in ("reward", "cost"):
        total = f"episode_{name}"
        if total not in figures:
            step = after[name]
            if not step.is_floating_point():  # A sum of flags is a flag.
                step = step.to(torch.get_default_dtype())
            figures[total] = step if before is None else before[total] + step
    return figures
