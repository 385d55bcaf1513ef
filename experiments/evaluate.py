"""Plays with a policy that was saved: how good it is, how safe, and what it looks like.

``python -m experiments.evaluate --policy runs/x/ppo-lagrangian/policy.pt`` plays in the environment
of its training, ``--policy panda-reach-in-front`` with a policy that comes with the package, and
``--env my_module:make_env`` in an environment of your own.
"""

from __future__ import annotations

import importlib
import json
import math
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import torch
import tyro
from tensordict import TensorDict, TensorDictBase
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type

from experiments.agent import num_costs
from experiments.config import Config as TrainConfig, Engine
from experiments.environment import make_env
from experiments.files import write_whole
from experiments.film import base_env, check_film, save_film
from experiments.report import figures_table
from torchrl_safe._checks import check_count
from torchrl_safe.envs import ArmEnv
from torchrl_safe.envs.gym import SafeGymEnv, SafeGymWrapper
from torchrl_safe.evaluation import evaluate, summarize
from torchrl_safe.metrics import conditional_value_at_risk, violation_rate
from torchrl_safe.policy import Policy, load_policy

# The settings of a training run that make its environment. Older files lack some of them.
_ENVIRONMENT = (
    "arm", "task", "obstacles", "action", "observation", "paper",
    "cost_limit", "costs", "suite_task", "physics",
)  # fmt: skip


@dataclass(frozen=True)
class Config:
    """Evaluate a policy that was saved on its own."""

    policy: Path
    """File that training has written, runs/.../policy.pt, or the name of a policy that comes with
    the package, such as panda-reach-in-front."""
    env: str | None = None
    """An environment of your own, as module:function. Called as function(num_envs=...), it
    returns an ArmEnv, or any environment with reward and cost. Without it, the environment that
    make train trained in."""
    physics: Engine | None = None
    """Engine that simulates the arm; by default that of the training."""
    episodes: int = 256
    """Episodes to play at least, with the deterministic policy."""
    envs: int = 32
    """Worlds to play in side by side."""
    max_steps: int = 10_000
    """Steps in which every episode must end."""
    seed: int = 1_000_000
    """Seed of the episodes."""
    cost_limits: tuple[float, ...] = ()
    """Limit of each cost of an episode; by default those of the training."""
    gui: bool = False
    """Show some episodes in a window, in real time. Needs a screen, and physics bullet."""
    video: Path | None = None
    """Film some episodes of an arm into this file, .gif or .webp, in slow motion."""
    shown: int = 4
    """Episodes to show or film."""
    out: Path | None = None
    """Folder for table.md and results.json; by default the table is only printed."""

    def __post_init__(self) -> None:
        check_count(least=2, episodes=self.episodes)
        check_count(envs=self.envs, shown=self.shown)
        if not all(0 <= limit < math.inf for limit in self.cost_limits):
            raise ValueError(f"cost_limits must not be negative, got {self.cost_limits}.")
        if self.video is not None:
            check_film("video", self.video)
        if self.physics is not None and self.env is not None:
            raise ValueError(
                f"physics must not be given with env, got {self.physics!r} and {self.env!r}: "
                "choose it there."
            )
        if self.gui and self.env is not None:
            raise ValueError(f"gui must not be given with env, got {self.env!r}: open it there.")


def factory(config: Config, saved: Policy) -> Callable[..., EnvBase]:
    """Returns what makes the environment, called with ``num_envs``."""
    if config.env is None:
        if "env" in saved.settings:
            # Not called without being asked: a file may name any function.
            raise ValueError(
                f"env must be given for a policy that was trained in {saved.settings['env']}."
            )
        if "name" not in saved.settings:  # Of a loop of one's own.
            raise ValueError(
                "env must be given for a policy whose file does not say what it was trained in: "
                "only those of make train and make ray do."
            )
        trained = training_config(saved)
        if config.physics is not None:
            trained = replace(trained, physics=config.physics)
        if config.gui and trained.physics != "bullet":
            raise ValueError(
                f"gui needs physics=bullet, got {trained.physics!r}, which has no window here: "
                "make a video instead."
            )
        return partial(make_env, trained, algorithm=saved.settings["name"])
    module, _, function = config.env.partition(":")
    if not function:
        raise ValueError(f"env must be module:function, got {config.env!r}.")
    sys.path.insert(0, str(Path.cwd()))
    return getattr(importlib.import_module(module), function)


def training_config(saved: Policy) -> TrainConfig:
    """What of its training's settings the environment is made of."""
    known = {name: saved.settings[name] for name in _ENVIRONMENT if name in saved.settings}
    return TrainConfig(**known, algorithms=(saved.settings["name"],))


def cost_limits(config: Config, saved: Policy) -> tuple[float, ...]:
    """The limits that are given, or else those of the training."""
    if config.cost_limits:
        return config.cost_limits
    settings = saved.settings
    if "cost_keys" in settings:  # Of safe_gym: one limit may be for all.
        limits = settings["cost_limit"]
        return tuple(limits * len(settings["cost_keys"]) if len(limits) == 1 else limits)
    if "name" in settings:  # Of make train.
        return tuple(training_config(saved).cost_limits.values())
    return tuple(settings.get("cost_limits", ()))


def check_fit(env: EnvBase, saved: Policy, config: Config) -> None:
    """Raises ValueError unless the environment is one that can be played as it is asked for."""
    shapes = {
        "observations": (env.observation_spec_unbatched["observation"], saved.observation_shape),
        "actions": (env.action_spec_unbatched, saved.action_shape),
    }
    for name, (spec, shape) in shapes.items():
        if spec.shape != shape:
            raise ValueError(
                f"env must have {name} of shape {shape}, which the policy was trained for, got "
                f"{tuple(spec.shape)}."
            )
    costs, limits = num_costs(env), cost_limits(config, saved)
    if len(limits) != costs:
        raise ValueError(
            f"cost_limits must be one for each of the {costs} costs of env, got {limits}: pass "
            "--cost-limits."
        )
    if config.video is not None and not isinstance(base_env(env), ArmEnv):
        raise ValueError(f"video films an ArmEnv, got {str(config.video)!r} with {env}.")


def cost_names(env: EnvBase) -> tuple[str, ...]:
    """Names of the costs; those of an environment that is not ours are "cost", or numbered."""
    base, count = base_env(env), num_costs(env)
    if isinstance(base, ArmEnv | SafeGymEnv | SafeGymWrapper):
        return base.cost_names
    return ("cost",) if count == 1 else tuple(f"cost {index}" for index in range(count))


def play(
    env: EnvBase, saved: Policy, config: Config, limits: tuple[float, ...]
) -> dict[str, list[float]]:
    """Plays the episodes; returns their figures, each with its interval where it has one."""
    episodes = evaluate(
        env, saved.actor, config.episodes, seed=config.seed, max_steps=config.max_steps
    )
    names = cost_names(env)
    return {**summarize(episodes, names), **safety(episodes, names, limits)}


def safety(
    episodes: TensorDict, names: tuple[str, ...], limits: tuple[float, ...]
) -> dict[str, list[float]]:
    """What the means do not tell: episodes above the limit, and the worst tenth of them."""
    figures = {}
    columns = episodes["episode_cost"].split(1, -1)
    for name, column, limit in zip(names, columns, limits, strict=True):
        figures[f"above/{name}"] = torch.cat(violation_rate(column, limit)).tolist()
        figures[f"worst/{name}"] = conditional_value_at_risk(column, 0.1).tolist()
    return figures


def watch(env: EnvBase, policy: Callable[[TensorDictBase], TensorDictBase], episodes: int) -> None:
    """Plays in real time."""
    begin, steps = time.perf_counter(), 0

    def wait(env: EnvBase, tensordict: TensorDictBase) -> None:
        nonlocal steps
        steps += 1
        time.sleep(max(0.0, begin + steps / env.control_rate - time.perf_counter()))

    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        for _ in range(episodes):
            env.rollout(env.max_episode_steps, policy, callback=wait)


def main(config: Config) -> None:
    """Evaluates, prints the table, and shows or films what was asked for."""
    torch.set_num_threads(1)
    saved = load_policy(config.policy)
    make_env = factory(config, saved)
    limits = cost_limits(config, saved)
    env = make_env(num_envs=config.envs)
    try:
        check_fit(env, saved, config)
        figures, names = play(env, saved, config, limits), cost_names(env)
    finally:
        env.close()
    # A policy of the package is in no folder.
    name = config.policy.parent.name or config.policy.name
    text = figures_table({name: figures}, dict(zip(names, limits, strict=True)))
    print(text)
    if config.out is not None:
        config.out.mkdir(parents=True, exist_ok=True)
        write_whole(config.out / "table.md", text)
        results = {"policy": str(config.policy), "cost_limits": limits, "evaluation": figures}
        write_whole(config.out / "results.json", json.dumps(results, indent=1))
    if config.video is not None:
        stage = make_env(num_envs=1)
        save_film(
            {saved.settings.get("name", config.policy.parent.name): (stage, saved.actor)},
            config.video,
            seed=config.seed,
            limits=dict(zip(names, limits, strict=True)),
            episodes=config.shown,
        )
        stage.close()
    if config.gui:
        stage = make_env(num_envs=1, gui=True)
        stage.set_seed(config.seed)
        watch(stage, saved.actor, config.shown)
        stage.close()


if __name__ == "__main__":
    main(tyro.cli(Config))
