"""Policies in another world than that of their training: ``python -m experiments.transfer``.

Plays in the other engine, past wider obstacles, with weaker and stronger motors, other masses and
friction, noisy observations, and actions that come a control step late. To resume it, repeat the
command.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
import torch
import tyro
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase, Transform, TransformedEnv

from experiments.algorithms import ALGORITHMS, no_transforms
from experiments.environment import PHYSICS
from experiments.grid import check_grid, run_grid, save_results
from experiments.suite_report import excess
from experiments.tables import markdown, shown_cost
from torchrl_safe._checks import check_count
from torchrl_safe._cores import cores
from torchrl_safe.envs import (
    SUITE,
    ArmState,
    Box,
    FullObservation,
    Obstacles,
    Placement,
    Scene,
    Shape,
    Shield,
    SuiteTask,
)
from torchrl_safe.evaluation import evaluate, summarize
from torchrl_safe.policy import load_policy, shipped_policies

Condition = Literal[
    "as trained",
    "other engine",
    "wider obstacles",
    "weak motors",
    "strong motors",
    "heavy links",
    "light links",
    "heavy object",
    "light object",
    "rough",
    "smooth",
    "noise",
    "delay",
]
# By how much sizes, motors, masses and friction change.
_CHANGE = 0.2
_SCENES: dict[Condition, Scene] = {
    "weak motors": Scene(motor_strength=1 - _CHANGE),
    "strong motors": Scene(motor_strength=1 + _CHANGE),
    "heavy links": Scene(link_mass=1 + _CHANGE),
    "light links": Scene(link_mass=1 - _CHANGE),
    "rough": Scene(friction=1 + _CHANGE),
    "smooth": Scene(friction=1 - _CHANGE),
}


@dataclasses.dataclass(frozen=True)
class Config:
    """Evaluate policies under changed conditions."""

    policies: tuple[str, ...] = ()
    """Names of policies that come with the package, or files of a suite's policies; by default all
    that come with it."""
    conditions: tuple[Condition, ...] = get_args(Condition)
    """What is changed: a size, a strength, a mass or friction by 20 %; the noise has a standard
    deviation of 0.01 rad, m and so on, the delay is one control step."""
    episodes: int = 256
    """Episodes of each policy under each condition, the same for all."""
    seed: int = 3_000_000
    """Seed of the episodes; that of the cards."""
    jobs: int = cores()
    """Evaluations side by side."""
    out: Path = Path("runs/transfer")
    """Folder of results; what is already there is not played again."""

    def __post_init__(self) -> None:
        check_grid(self, "conditions")
        check_count(least=2, episodes=self.episodes)
        if not self.chosen:
            raise ValueError("policies must name at least one: none comes with the package.")

    @property
    def chosen(self) -> tuple[str, ...]:
        """What to play with: ``policies``, or all that come with the package."""
        return self.policies or tuple(shipped_policies())


@dataclasses.dataclass(frozen=True)
class Wider:
    """A layout with wider obstacles in the same places, as high as before.

    Args:
        layout: the layout.
        factor: how much wider.
    """

    layout: Obstacles
    factor: float

    @property
    def shapes(self) -> tuple[Shape, ...]:
        return tuple(widen(shape, self.factor) for shape in self.layout.shapes)

    def sample(self, rng: np.random.Generator, start: np.ndarray, goal: np.ndarray) -> Placement:
        return self.layout.sample(rng, start, goal)


def widen(shape: Shape, factor: float) -> Shape:
    """A shape with its horizontal sizes multiplied; of a ball all are."""
    if isinstance(shape, Box):
        x, y, z = shape.half_extents
        return dataclasses.replace(shape, half_extents=(factor * x, factor * y, z))
    return dataclasses.replace(shape, radius=factor * shape.radius)


class Noisy:
    """An observation with noise in every number.

    Args:
        observation: the observation.
        deviation: standard deviation, in the units of each number.
        seed: seed of the noise.
    """

    def __init__(
        self, observation: Callable[[ArmState], dict[str, Any]], deviation: float, *, seed: int
    ) -> None:
        self.observation, self.deviation = observation, deviation
        self._generator = np.random.default_rng(seed)

    def __call__(self, state: ArmState) -> dict[str, Any]:
        fields = self.observation(state)
        return {
            name: field + self.deviation * self._generator.standard_normal(np.shape(field))
            for name, field in fields.items()
        }


class Delay(Transform):
    """Gives the environment the action of the step before; 0 in the first step of an episode."""

    def __init__(self) -> None:
        super().__init__(in_keys_inv=["action"], out_keys_inv=["action"])
        self._before: Tensor | None = None

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        action = tensordict["action"]
        before = torch.zeros_like(action) if self._before is None else self._before
        self._before = action.clone()
        return tensordict.set("action", before)

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        mask = None if tensordict is None else tensordict.get("_reset", None)
        if mask is None or self._before is None:
            self._before = None
        else:
            self._before = torch.where(mask, 0.0, self._before)
        return tensordict_reset


def scale_object_mass(task: SuiteTask, factor: float) -> SuiteTask:
    """The same task with the mass of its object multiplied."""
    shape = task.task.shape  # type: ignore[attr-defined]
    shape = dataclasses.replace(shape, mass=factor * shape.mass)
    return dataclasses.replace(task, task=dataclasses.replace(task.task, shape=shape))  # type: ignore[type-var]


def applies(task: SuiteTask, condition: Condition) -> bool:
    """Whether there is something to change; friction is that between gripper, object and table."""
    with_object = condition.endswith("object") or condition in ("rough", "smooth")
    return bool(task.task.objects) or not with_object


def make_env(
    task: SuiteTask,
    condition: Condition,
    *,
    physics: str,
    num_envs: int,
    seed: int,
    shield: Shield | None = None,
) -> EnvBase:
    """Makes the environment of a task under a condition.

    Args:
        task: the task.
        condition: what is changed.
        physics: the engine of the training.
        num_envs: worlds.
        seed: seed of the noise.
        shield: filters the actions, if given.
    """
    scene = _SCENES.get(condition, Scene())
    settings: dict[str, Any] = {"num_envs": num_envs, "scene": scene, "shield": shield}
    match condition:
        case "other engine":
            physics = "bullet" if physics == "mujoco" else "mujoco"
        case "wider obstacles":
            wider = Wider(task.obstacles, 1 + _CHANGE)
            task = dataclasses.replace(task, obstacles=wider)
        case "heavy object":
            task = scale_object_mass(task, 1 + _CHANGE)
        case "light object":
            task = scale_object_mass(task, 1 - _CHANGE)
        case "noise":
            settings["observation"] = Noisy(FullObservation(), 0.01, seed=seed)
    env = task.make_env(physics=PHYSICS[physics], **settings)
    return TransformedEnv(env, Delay()) if condition == "delay" else env


def run(policy: str, condition: Condition, episodes: int, seed: int) -> dict[str, Any]:
    """Plays with a policy under a condition; returns its task and its figures."""
    torch.set_num_threads(1)
    saved = load_policy(policy)
    name = saved.settings.get("suite_task")
    if name is None:
        raise ValueError(f"policies must be of tasks of the suite, got {policy!r}.")
    algorithm = ALGORITHMS[saved.settings["name"]]
    if algorithm.transforms is not no_transforms:
        raise ValueError(
            f"policies must observe what the task has, got {policy!r} of {saved.settings['name']}."
        )
    task = SUITE[name]
    if not applies(task, condition):
        return {"task": name, "evaluation": None}
    physics = saved.settings["physics"]
    env = make_env(
        task, condition, physics=physics, num_envs=32, seed=seed, shield=algorithm.shield
    )
    try:
        played = evaluate(env, saved.actor, episodes, seed=seed)
    finally:
        env.close()
    return {"task": name, "evaluation": summarize(played, tuple(task.cost_limits))}


def table(runs: Sequence[dict[str, Any]]) -> str:
    """Returns a Markdown table: a row for each condition, success and costs of each policy.

    A cost above its limit is bold.
    """
    conditions = [*dict.fromkeys(run["condition"] for run in runs)]
    policies = dict.fromkeys((run["policy"], run["task"]) for run in runs)
    figures = {(run["policy"], run["condition"]): run["evaluation"] for run in runs}
    limits = {policy: SUITE[task].cost_limits for policy, task in policies}
    shown = [", ".join(f"{n} {limit:g}" for n, limit in each.items()) for each in limits.values()]
    rows = [("limits", *shown, "")]
    for condition in conditions:
        row = {name: figures[name, condition] for name in limits}
        played = {name: each for name, each in row.items() if each is not None}
        kept = sum(excess(each, limits[name]) <= 1 for name, each in played.items())
        cells = [_cell(each, limits[name]) for name, each in row.items()]
        rows.append((condition, *cells, f"{kept}/{len(played)}"))
    text = markdown(("", *limits, "within every limit"), rows)
    return f"{text}\n\nSuccess; the mean of each cost, bold where it is above its limit."


def name_of(policy: str) -> str:
    """What a policy is called: its file, or the folders of one that training has written."""
    path = Path(policy)
    return "-".join(path.parts[-4:-1]) if path.name == "policy.pt" else path.stem


def _cell(figures: Mapping[str, Any] | None, limits: Mapping[str, float]) -> str:
    if figures is None:
        return ""
    shown = [shown_cost(figures[f"cost/{name}"][0], limit) for name, limit in limits.items()]
    return f"{figures['success'][0]:.0%}; {', '.join(shown)}"


def main(config: Config) -> None:
    """Plays what is missing, then writes the table and results.json."""
    cases = list(product(config.chosen, config.conditions))
    jobs = {
        config.out / f"{name_of(policy)}-{condition.replace(' ', '-')}.json": (
            policy,
            condition,
            config.episodes,
            config.seed,
        )
        for policy, condition in cases
    }
    if len(jobs) < len(cases):
        raise ValueError(f"policies must have different names, got {config.chosen}.")
    results = run_grid(run, jobs, workers=config.jobs, name="transfer")
    runs = [
        {"policy": name_of(policy), "condition": condition, **result}
        for (policy, condition), result in zip(cases, results, strict=True)
    ]
    save_results(config.out, config, runs, table(runs))


if __name__ == "__main__":
    main(tyro.cli(Config))
