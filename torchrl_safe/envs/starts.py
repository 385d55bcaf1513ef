"""How an episode begins."""

from __future__ import annotations

import numpy as np

from torchrl_safe._checks import check_array, check_kind
from torchrl_safe.envs.arms import ArmModel
from torchrl_safe.envs.kinematics import distance_to_reach
from torchrl_safe.envs.obstacles import Obstacles, Placement
from torchrl_safe.envs.physics.simulator import Simulator
from torchrl_safe.envs.regions import NoRoomError
from torchrl_safe.envs.state import Array
from torchrl_safe.envs.tasks import Task

# Episodes that are tried when an environment is made, and how near, m, counts as reached in them.
_CHECKED_STARTS, _REACHED = 50, 0.02
# Draws for a start in the check, and for one in a run. Whatever share of the draws is unusable, the
# probability to pass the check and then fail in a given episode is below 1e-11.
_CHECKED_DRAWS, _DRAWS = 100, 1000


class Starts:
    """Draws goal, objects and obstacles, and puts a world there.

    A draw is unusable if task or layout raise :class:`~torchrl_safe.envs.NoRoomError`, or if an
    obstacle touches the arm at home or an object. Then everything is drawn again, the goal too,
    because some goals leave a layout no room.

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
        """Tries some starts, so that errors show now rather than after hours of training.

        It finds goals out of reach, and goals that leave the obstacles no room.

        Raises:
            ValueError: if the arm does not reach what the task draws, or is hardly ever free.
        """
        generator = np.random.default_rng(0)
        drawn = [self._begin(0, generator, _CHECKED_DRAWS) for _ in range(_CHECKED_STARTS)]
        goals, objects = zip(*drawn, strict=True)
        named = {"goals": np.stack(goals)}
        if self._task.objects:
            named["objects"] = np.concatenate(objects)
        for name, points in named.items():
            misses = distance_to_reach(self._simulator, self._arm.home, points)
            for point, miss in zip(points, misses, strict=True):
                if miss > _REACHED:
                    raise ValueError(
                        f"task must draw {name} that the arm can reach, got "
                        f"{point.round(3).tolist()} from {self._task}, from which the tool "
                        f"stays {miss:.3f} m away: give the task another region, or the "
                        "arm other goals."
                    )

    def begin(self, row: int, generator: np.random.Generator) -> None:
        """Begins an episode in one world.

        Raises:
            ValueError: if what is drawn has a wrong shape or is not finite.
        """
        self._begin(row, generator, _DRAWS)

    def _begin(self, row: int, generator: np.random.Generator, draws: int) -> tuple[Array, Array]:
        """Begins an episode within so many draws; returns its goal and objects."""
        for _ in range(draws):
            try:
                goal, objects = self._draw_task(generator)
                placement = self._draw_obstacles(generator, goal, objects)
                self._simulator.reset(row, placement, goal, objects)
                self._check_free(row)
            except NoRoomError as error:
                last = error
            else:
                return goal, objects
        raise ValueError(f"{last} None of {draws} draws of {self._task} was usable.")

    def _check_free(self, row: int) -> None:
        if (clearance := self._simulator.clearance(row)) <= 0:
            raise NoRoomError(
                "obstacles and objects must leave free the arm at home and the objects, got an "
                f"overlap of {-clearance:.4f} m from {self._obstacles} and {self._task}."
            )

    def _draw_task(self, generator: np.random.Generator) -> tuple[Array, Array]:
        drawn = self._task.sample(generator, self._arm.goals)
        if not isinstance(drawn, tuple | list) or len(drawn) != 2:
            raise ValueError(
                "sample of the task must return two arrays, the goal and the objects' centres, "
                f"got {drawn!r}."
            )
        goal = check_array("goal", drawn[0], (3,))
        return goal, check_array("objects", drawn[1], (len(self._task.objects), 3))

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
