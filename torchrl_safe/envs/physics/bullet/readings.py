"""Measures in one world what costs ask for. A part of ``world.py``."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple, TypeVar

from torchrl_safe.envs.physics.bullet.bodies import LoadedArm
from torchrl_safe.envs.physics.bullet.engine import pybullet
from torchrl_safe.envs.state import Array, Sensing

Vector = Sequence[float]
Number = TypeVar("Number", float, Array)


class MovingBody(NamedTuple):
    """An obstacle as it is now."""

    #: Its number.
    body: int
    #: Its centre, m.
    centre: Vector
    #: Velocity of its centre, m/s.
    velocity: Vector
    #: Angular velocity, rad/s.
    angular_velocity: Vector


class Readings:
    """What :class:`~torchrl_safe.envs.Sensing` describes, read from PyBullet.

    Args:
        client: number of the server.
        arm: the arm.
        furniture: numbers of the bodies that count as the table.
        num_obstacles: number of obstacles, present or not.
        sensing: what is measured.
        fresh_links: read links where they are now. Bullet then forgets where they were one substep
            ago.
    """

    def __init__(
        self,
        client: int,
        arm: LoadedArm,
        furniture: Sequence[int],
        num_obstacles: int,
        sensing: Sensing,
        *,
        fresh_links: bool,
    ) -> None:
        self._client, self._arm, self._furniture = client, arm, furniture
        self._num_obstacles = num_obstacles
        self._num_links = pybullet.getNumJoints(arm.body, physicsClientId=client)
        self._fresh_links = fresh_links
        self.sensing = sensing

    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Names and shapes of the parts of a row that :meth:`read` returns."""
        sensing = self.sensing
        shapes: dict[str, tuple[int, ...]] = {}
        if sensing.clearance:
            names = ("clearance", "arm_approach", "obstacle_approach")
            shapes |= dict.fromkeys(names, (self._num_obstacles,))
        if sensing.table:
            shapes["table_distance"] = ()
        if sensing.itself:
            shapes["self_distance"] = ()
        if sensing.joints:
            shapes["joint_position"] = (len(self._arm.joints),)
        if sensing.tool:
            shapes |= {"ee_position": (3,), "ee_velocity": (3,)}
        if sensing.links:
            shapes["link_speed"] = (self._num_links,)
        return shapes

    def read(self, obstacles: Sequence[MovingBody | None], *, touches: bool) -> list[float]:
        """Returns the measurements as one flat row.

        Args:
            obstacles: the obstacles; None for those that are not present.
            touches: read contact points, which are those of the last substep. After a reset there
                was none.
        """
        sensing, client, arm = self.sensing, self._client, self._arm
        row: list[float] = []
        if sensing.clearance:
            nearest = [self._nearest(obstacle) for obstacle in obstacles]
            row = [part for parts in zip(*nearest, strict=True) for part in parts]
        if sensing.table:
            row.append(self._touch(self._furniture) if touches else math.inf)
        if sensing.itself:
            row.append(self._touch([arm.body]) if touches else math.inf)
        if sensing.joints:
            states = pybullet.getJointStates(arm.body, arm.joints, physicsClientId=client)
            row += [state[0] for state in states]
        if sensing.tool:
            link = link_state(client, arm.body, arm.ee, fresh=self._fresh_links)
            row += [*link[4], *velocity_at(link[4], link[0], link[6], link[7])]
        if sensing.links:
            links = pybullet.getLinkStates(
                arm.body, range(self._num_links), computeLinkVelocity=1, physicsClientId=client
            )
            row += [math.hypot(*state[6]) for state in links]
        return row

    def _nearest(self, obstacle: MovingBody | None) -> tuple[float, float, float]:
        """Distance of arm and obstacle, and the speeds of their closest points to each other."""
        client, arm = self._client, self._arm.body
        points = obstacle and pybullet.getClosestPoints(
            arm, obstacle.body, self.sensing.clearance, physicsClientId=client
        )
        if not obstacle or not points:
            return math.inf, 0.0, 0.0
        point = min(points, key=lambda point: point[8])
        link, on_arm, on_obstacle, normal = point[3], point[5], point[6], point[7]
        arm_velocity: Vector = (0.0, 0.0, 0.0)
        if link >= 0:
            state = link_state(client, arm, link, fresh=self._fresh_links)
            arm_velocity = velocity_at(on_arm, state[0], state[6], state[7])
        obstacle_velocity = velocity_at(on_obstacle, *obstacle[1:])
        # The normal points from the obstacle to the arm.
        return point[8], -_dot(arm_velocity, normal), _dot(obstacle_velocity, normal)

    def _touch(self, bodies: Sequence[int]) -> float:
        """Smallest distance among the contact points of what moves of the arm with bodies.

        It is at most 0 where they push: the solver holds them a hair apart.
        """
        base = self._arm.base
        return min(
            (
                min(point[8], 0.0) if point[9] > 0 else point[8]
                for body in bodies
                for point in pybullet.getContactPoints(
                    self._arm.body, body, physicsClientId=self._client
                )
                # Of two links of the arm, one may be the base.
                if point[3] not in base or (body == self._arm.body and point[4] not in base)
            ),
            default=math.inf,
        )


def link_state(client: int, body: int, link: int, *, fresh: bool) -> tuple:
    """PyBullet's record of a link with its velocity, of now or of one substep ago."""
    return pybullet.getLinkState(
        body,
        link,
        computeLinkVelocity=1,
        computeForwardKinematics=int(fresh),
        physicsClientId=client,
    )


def velocity_at(
    point: Sequence[Number],
    centre: Sequence[Number],
    linear: Sequence[Number],
    angular: Sequence[Number],
) -> tuple[Number, Number, Number]:
    """Velocity of a point of a body whose centre of mass has the given velocities.

    Each is three numbers, or three arrays for many bodies at once.
    """
    x, y, z = (p - c for p, c in zip(point, centre, strict=True))
    wx, wy, wz = angular
    return (
        linear[0] + wy * z - wz * y,
        linear[1] + wz * x - wx * z,
        linear[2] + wx * y - wy * x,
    )


def _dot(first: Vector, second: Vector) -> float:
    return sum(a * b for a, b in zip(first, second, strict=True))
