"""How an episode begins."""

from __future__ import annotations

import numpy as np

from torchrl_safe.envs.arms import ArmModel
from torchrl_safe.envs.checks import check_array, check_kind
from torchrl_safe.envs.kinematics import distance_to_reach
from torchrl_safe.envs.obstacles import Obstacles, Placement
from torchrl_safe.envs.physics.simulator import Simulator
from torchrl_safe.envs.state import Array
from torchrl_safe.envs.tasks import Task

# Episodes that are tried when an environment is made; how near, in m, counts as reached there;
# and how often obstacles are drawn until they leave the arm free.
_CHECKED_STARTS, _REACHED, _ATTEMPTS = 50, 0.02, 100


class Starts:
    """Draws goal, objects and obstacles, and puts a world there.

    Args:
        arm: the arm.
        task: what draws goal and objects.
        obstacles: what draws where the obstacles are.
        simulator: the worlds.
    """

    def __init__(
        self, arm: ArmModel, task: Task, obstacles: Obstacles, simulator: Simulator
    ) -> None:
        self._arm, self._task, self._obstacles, self._simulator = arm, task, obstacles, simulator

    def check(self) -> None:
        """Tries some.

        Goals out of reach, or that leave the obstacles no room, show here rather than after hours
        of training.

        Raises:
            ValueError: if the arm does not reach what the task draws, or is not free.
        """
        generator = np.random.default_rng(0)
        for _ in range(_CHECKED_STARTS):
            goal, objects = self._draw_task(generator)
            for name, points in (("goals", goal[None]), ("objects", objects)):
                for point in points:
                    miss = distance_to_reach(self._simulator, self._arm.home, point)
                    if miss > _REACHED:
                        raise ValueError(
                            f"task must draw {name} that the arm can reach, got "
                            f"{point.round(3).tolist()} from {self._task}, from which the tool "
                            f"stays {miss:.3f} m away: give the task another region, or the "
                            "arm other goals."
                        )
            self.begin(0, generator)

    def begin(self, row: int, generator: np.random.Generator) -> None:
        """Begins an episode in one world.

        Raises:
            ValueError: if what is drawn is not usable, or never leaves the arm free.
        """
        goal, objects = self._draw_task(generator)
        for _ in range(_ATTEMPTS):
            placement = self._draw_obstacles(generator, goal, objects)
            self._simulator.reset(row, placement, goal, objects)
            if (clearance := self._simulator.clearance(row)) > 0:
                return
        raise ValueError(
            f"obstacles must leave the arm free at home and the objects where they are, got an "
            f"overlap of {-clearance:.4f} m from {self._obstacles}."
        )

    def _draw_task(self, generator: np.random.Generator) -> tuple[Array, Array]:
        goal, objects = self._task.sample(generator, self._arm.goals)
        goal = check_array("goal", goal, (3,))
        return goal, check_array("objects", objects, (len(self._task.objects), 3))

    def _draw_obstacles(
        self, generator: np.random.Generator, goal: Array, objects: Array
    ) -> Placement:
        start = objects[0] if len(objects) else self._simulator.home_position
        placement = self._obstacles.sample(generator, start, goal)
        check_kind("placement", placement, Placement)
        shapes = self._obstacles.shapes
        check_array("obstacle positions", placement.position, (len(shapes), 3))
        if placement.path is not None and any(shape.mass for shape in shapes):
            raise ValueError(f"path moves fixed shapes only (mass 0), got one for {shapes}.")
        return placement
