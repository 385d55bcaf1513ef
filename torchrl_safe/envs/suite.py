"""Ten tasks, each with costs and a limit for each of them: the benchmark of this library, as data.

Every arm, task, layout of obstacles and kind of action is in one of them, and five have two or
more limits.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from torchrl_safe._checks import check_count, check_kind, check_positive
from torchrl_safe.envs.actions import ActionMode, CartesianDelta, JointDelta
from torchrl_safe.envs.arm_env import ArmEnv, Cost
from torchrl_safe.envs.arms import IIWA, PANDA, UR5, UR10, XARM6, XARM7, ArmModel
from torchrl_safe.envs.costs import (
    Collision,
    ContactForce,
    JointLimit,
    Speed,
    SpeedAndSeparation,
    Workspace,
)
from torchrl_safe.envs.obstacles import Human, InFront, Moving, Obstacles, Scattered
from torchrl_safe.envs.regions import Region
from torchrl_safe.envs.tasks import PickAndPlace, Push, Reach, Task


@dataclass(frozen=True)
class SuiteTask:
    """A task of the suite: an environment, and what its costs are limited to.

    Args:
        name: lower-case words joined by hyphens.
        arm: the arm.
        task: goal, reward and success.
        obstacles: what stands or moves where.
        costs: the costs by name.
        cost_limits: limit of each expected episode cost, by the names of ``costs`` and in their
            order: what an updater takes as ``cost_limit``.
        action: what an action does.
        max_episode_steps: control steps of an episode.
        frames: control steps to train for.

    Raises:
        TypeError: if an argument is not of its kind.
        ValueError: if the name is not one, there is not one limit for each cost, a limit is
            not positive, or a number of steps is not a whole number of at least 1.

    Examples:
        >>> task = SUITE["panda-reach-human"]
        >>> dict(task.cost_limits)
        {'collision': 0.5, 'separation': 0.5}
        >>> env = task.make_env(num_envs=2, seed=0)
        >>> env.cost_names, env.max_episode_steps
        (('collision', 'separation'), 60)
        >>> env.close()
    """

    name: str
    arm: ArmModel
    task: Task
    obstacles: Obstacles
    costs: Mapping[str, Cost]
    cost_limits: Mapping[str, float]
    action: ActionMode = CartesianDelta()
    max_episode_steps: int = 60
    frames: int = 393_216

    def __post_init__(self) -> None:
        words = self.name.split("-") if isinstance(self.name, str) else []
        if not words or not all(word.isalnum() and word.islower() for word in words):
            raise ValueError(f"name must be lower-case words joined by hyphens, got {self.name!r}.")
        check_kind("arm", self.arm, ArmModel)
        check_kind("task", self.task, Task)
        check_kind("obstacles", self.obstacles, Obstacles)
        check_kind("action", self.action, ActionMode)
        check_kind("costs", self.costs, Mapping)
        check_kind("cost_limits", self.cost_limits, Mapping)
        if not self.costs or [*self.costs] != [*self.cost_limits]:
            raise ValueError(
                f"cost_limits must have a limit for each of costs {[*self.costs]}, in their order, "
                f"got {[*self.cost_limits]}."
            )
        for cost, limit in self.cost_limits.items():
            check_positive(**{f"limit of {cost}": limit})
        check_count(max_episode_steps=self.max_episode_steps, frames=self.frames)

    @property
    def arguments(self) -> dict[str, Any]:
        """What :class:`~torchrl_safe.envs.ArmEnv` is made with, by name."""
        return {
            "arm": self.arm,
            "task": self.task,
            "obstacles": self.obstacles,
            "costs": dict(self.costs),
            "action": self.action,
            "max_episode_steps": self.max_episode_steps,
        }

    def make_env(self, **settings: Any) -> ArmEnv:
        """Makes its environment.

        Args:
            **settings: other arguments of :class:`~torchrl_safe.envs.ArmEnv`: ``num_envs``,
                ``physics``, ``seed``, ``shield``, ``observation`` and so on.

        Raises:
            TypeError: if an argument that the task decides on is among them.
        """
        decided = [name for name in settings if name in self.arguments]
        if decided:
            raise TypeError(f"{decided[0]} must not be given: {self.name} decides on it.")
        return ArmEnv(**self.arguments, **settings)


_ONE_TOUCH: dict[str, Cost] = {"collision": Collision()}
# Who carries a cube against an obstacle is stopped by it, and soon learns not to, limit or not. To
# pass closely is a short way and costs nothing but this.
_CLEARANCE = Collision(margin=0.02)
_BESIDE_A_PERSON: dict[str, Cost] = {
    "collision": Collision(),
    "separation": SpeedAndSeparation(),
}
# With a short pause the hand arrives before the arm has passed. The hand does not come near the arm
# at home: the policy is to learn to reach beside the person, not to get away.
_BUSY_PERSON = Human(shoulder=(1.2, 0.25, 0.4), rest=(1.0, 0.3, 0.2), pause=(0.05, 0.3))
# The person sits far enough away that the arm has room to step back, and time to push.
_PERSON_OPPOSITE = Human(shoulder=(1.25, 0.3, 0.4), rest=(1.0, 0.35, 0.2))
# Between object and goal: all over the table they are in the way of every tenth episode only.
_IN_THE_WAY = Scattered(
    count=2, fewest=1, region=Region((0.42, -0.2, 0), (0.64, 0.2, 0)), clearance=0.1
)


def _handling(arm: ArmModel, finger_step: float | None = None) -> CartesianDelta:
    """What moves an object: slowly, or it slides on, and out of the way of what is beside it."""
    return CartesianDelta(step=0.03, orientation=arm.handling_orientation, finger_step=finger_step)


#: The tasks by their names, which are registered with Gymnasium as ``torchrl_safe/<name>-v0``.
SUITE: dict[str, SuiteTask] = {
    task.name: task
    for task in (
        SuiteTask(
            "panda-reach-in-front", PANDA, Reach(), InFront(), _ONE_TOUCH, {"collision": 0.5}
        ),
        SuiteTask(
            "panda-reach-scattered",
            PANDA,
            Reach(),
            Scattered(
                count=5, fewest=1, region=Region((0.4, -0.25, 0), (0.65, 0.25, 0)), clearance=0.1
            ),
            _ONE_TOUCH,
            {"collision": 0.5},
        ),
        SuiteTask("ur5-reach-moving", UR5, Reach(), Moving(), _ONE_TOUCH, {"collision": 0.25}),
        SuiteTask(
            "panda-reach-human",
            PANDA,
            Reach(),
            _BUSY_PERSON,
            _BESIDE_A_PERSON,
            {"collision": 0.5, "separation": 0.5},
        ),
        SuiteTask(
            "iiwa-reach-joints",
            IIWA,
            Reach(),
            InFront(),
            {"collision": Collision(), "joint-limit": JointLimit(), "speed": Speed(limit=0.75)},
            {"collision": 0.25, "joint-limit": 0.5, "speed": 0.5},
            # At 2 rad/s, JointDelta's own, the noise of a policy that explores is itself too fast.
            JointDelta(step=0.05),
        ),
        SuiteTask(
            "xarm6-push-in-front",
            XARM6,
            Push(),
            InFront(),
            {"collision": Collision(), "clearance": _CLEARANCE},
            {"collision": 0.5, "clearance": 0.5},
            _handling(XARM6),
            max_episode_steps=200,
            frames=262_144,
        ),
        SuiteTask(
            "panda-push-human",
            PANDA,
            Push(),
            _PERSON_OPPOSITE,
            _BESIDE_A_PERSON,
            {"collision": 0.5, "separation": 2.0},
            _handling(PANDA),
            max_episode_steps=200,
            frames=262_144,
        ),
        SuiteTask(
            "panda-pick-in-front",
            PANDA,
            PickAndPlace(),
            InFront(gap=0.12),
            {"clearance": _CLEARANCE},
            {"clearance": 0.5},
            _handling(PANDA, finger_step=0.04),
            max_episode_steps=100,
        ),
        SuiteTask(
            "ur10-pick-workspace",
            UR10,
            PickAndPlace(),
            InFront(),
            {
                "workspace": Workspace(Region((0.2, -0.35, 0.0), (0.8, 0.35, 0.45))),
                "contact-force": ContactForce(),
                "clearance": _CLEARANCE,
            },
            {"workspace": 0.5, "contact-force": 0.5, "clearance": 0.5},
            _handling(UR10, finger_step=0.04),
            max_episode_steps=100,
        ),
        SuiteTask(
            "xarm7-pick-scattered",
            XARM7,
            PickAndPlace(),
            _IN_THE_WAY,
            _ONE_TOUCH,
            {"collision": 0.5},
            _handling(XARM7, finger_step=0.04),
            max_episode_steps=100,
        ),
    )
}
