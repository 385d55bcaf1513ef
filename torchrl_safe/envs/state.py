"""The record that tasks, costs, actions and observations read, and what it can be asked for."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import astuple, dataclass, field
from typing import NoReturn, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from torchrl_safe._checks import check_flag, check_not_negative

Array = NDArray[np.float64]


# What a cost asks for to have a measurement in the trace.
_ASKED_FOR_BY = {
    "clearance": "clearance=0.1",
    "arm_approach": "clearance=0.1",
    "obstacle_approach": "clearance=0.1",
    "table_distance": "table=True",
    "self_distance": "itself=True",
    "joint_position": "joints=True",
    "ee_position": "tool=True",
    "ee_velocity": "tool=True",
    "link_speed": "links=True",
}


class Trace(dict[str, Array]):
    """Measurements of every physics substep, by name; asking for a missing one says why."""

    def __missing__(self, name: str) -> NoReturn:
        if name not in _ASKED_FOR_BY:
            raise KeyError(f"{name!r} must be one of {', '.join(_ASKED_FOR_BY)}.")
        raise KeyError(
            f"{name!r} is measured only if a cost asks for it with sensing = "
            f"Sensing({_ASKED_FOR_BY[name]}); there is {list(self)}."
        )


@dataclass(frozen=True)
class Sensing:
    """Measurements that a cost needs in every physics substep.

    Contacts between arm and obstacles are always measured. Everything else takes time, and is
    measured only if a cost of the environment asks. You find the measurements by name in
    :attr:`ArmState.trace`; N worlds, s substeps, m obstacles, n joints, l links:

    Args:
        clearance: distance up to which the arm is measured against each obstacle, m. Gives
            ``clearance``, the distance between their surfaces (m, infinite beyond that range),
            and the speeds (m/s) at which the two closest points move towards each other,
            ``arm_approach`` and ``obstacle_approach``; each ``(N, s, m)``.
        table: gives ``table_distance`` (m, ``(N, s)``): the smallest distance of a contact
            point between the table and the arm without its base, infinite without contact.
        itself: gives ``self_distance`` (m, ``(N, s)``), the same between links of the arm that
            touch neither at home nor with the gripper fully open or closed. Links then collide,
            which they otherwise do not.
        joints: gives ``joint_position`` (rad, ``(N, s, n)``).
        tool: gives ``ee_position`` (m) and ``ee_velocity`` (m/s), each ``(N, s, 3)``.
        links: gives ``link_speed`` (m/s, ``(N, s, l)``), of every link's centre of mass.

    Raises:
        ValueError: if ``clearance`` is negative or not finite.

    Examples:
        >>> Sensing(clearance=0.1) | Sensing(clearance=0.3, joints=True)
        Sensing(clearance=0.3, table=False, itself=False, joints=True, tool=False, links=False)
    """

    clearance: float = 0.0
    table: bool = False
    itself: bool = False
    joints: bool = False
    tool: bool = False
    links: bool = False

    def __post_init__(self) -> None:
        check_not_negative(clearance=self.clearance)
        check_flag(
            table=self.table,
            itself=self.itself,
            joints=self.joints,
            tool=self.tool,
            links=self.links,
        )

    def __or__(self, other: Sensing) -> Sensing:
        return Sensing(*map(max, astuple(self), astuple(other)))


@runtime_checkable
class Sensor(Protocol):
    """A cost that wants more to be measured than contacts.

    Examples:
        >>> from torchrl_safe.envs import ArmEnv
        >>> class HighestSpeed:
        ...     sensing = Sensing(tool=True)
        ...
        ...     def __call__(self, state):
        ...         speed = np.linalg.norm(state.trace["ee_velocity"], axis=2)  # (N, substeps)
        ...         return speed.max(axis=1)
        >>> isinstance(HighestSpeed(), Sensor)
        True
        >>> env = ArmEnv(costs={"speed": HighestSpeed()})
        >>> env.rollout(2)["next", "cost"].shape
        torch.Size([1, 2, 1])
        >>> env.close()
    """

    def __call__(self, state: ArmState) -> Array:
        """Returns the cost of each world, shape ``(N,)``."""

    @property
    def sensing(self) -> Sensing:
        """What the cost reads in :attr:`ArmState.trace`."""


@dataclass(frozen=True)
class ArmState:
    """State of N worlds after a control step or a reset, in SI units and world coordinates.

    n is the number of arm joints, f of free finger joints, p of objects that the task moves, m
    of obstacles. Orientations are quaternions (x, y, z, w). The arrays of an
    environment's states are read-only.

    Attributes:
        joint_position: joint angles, rad, ``(N, n)``.
        joint_velocity: joint velocities, rad/s, ``(N, n)``.
        joint_lower: lower joint limits, rad, ``(n,)``.
        joint_upper: upper joint limits, rad, ``(n,)``.
        finger_position: free finger joints, m, ``(N, f)``.
        ee_position: tool point, m, ``(N, 3)``.
        ee_orientation: tool orientation, ``(N, 4)``.
        ee_velocity: velocity of the tool point, m/s, ``(N, 3)``.
        goal: target position, m, ``(N, 3)``.
        object_position: centres of the objects, m, ``(N, p, 3)``.
        object_orientation: orientations of the objects, ``(N, p, 4)``.
        object_velocity: velocities of the objects, m/s, ``(N, p, 3)``.
        object_angular_velocity: rad/s, ``(N, p, 3)``.
        obstacle_position: centres of the obstacles, m, ``(N, m, 3)``; far away if not present.
        obstacle_orientation: orientations of the obstacles, ``(N, m, 4)``.
        obstacle_velocity: velocities of the obstacles, m/s, ``(N, m, 3)``.
        obstacle_angular_velocity: rad/s, ``(N, m, 3)``.
        obstacle_present: which obstacles a world has, bool, ``(N, m)``.
        obstacle_size: half extents of the obstacles along their own axes, m, ``(m, 3)``.
        contact_distance: smallest distance between arm and obstacle among the contact points
            of **all** physics substeps of the last control step, m, ``(N, m)``. Negative where
            they overlap, infinite where the simulator reports no contact.
        contact_force: largest force between arm and obstacle in any of these substeps: the sum
            of the normal forces at its contact points, N, ``(N, m)``.
        step: control steps since the episode began, int, ``(N,)``; 0 after a reset.
        time: simulated time since the episode began, s, ``(N,)``.
        trace: measurements of each substep that the costs asked for, see :class:`Sensing`.
        previous: the state at the beginning of the control step, whose own ``previous`` is
            ``None``; ``None`` after a reset.
        shield_correction: how far the joint targets of the last control step were from those that
            the action asked for, rad, ``(N,)``: the length of the difference. 0 after a reset;
            ``None`` without a :class:`~torchrl_safe.envs.Shield`.
        shield_braked: in which worlds the shield braked, bool, ``(N,)``: nothing near what was
            asked for was safe, or the arm was pressed on something. ``None`` without a shield.

    Examples:
        >>> from torchrl_safe.envs import ArmEnv
        >>> env = ArmEnv(num_envs=2, seed=0)
        >>> reset = env.reset()
        >>> env.arm_state.goal.shape, env.arm_state.obstacle_position.shape
        ((2, 3), (2, 1, 3))
        >>> env.arm_state.step
        array([0, 0])
        >>> env.close()
    """

    joint_position: Array
    joint_velocity: Array
    joint_lower: Array
    joint_upper: Array
    finger_position: Array
    ee_position: Array
    ee_orientation: Array
    ee_velocity: Array
    goal: Array
    object_position: Array
    object_orientation: Array
    object_velocity: Array
    object_angular_velocity: Array
    obstacle_position: Array
    obstacle_orientation: Array
    obstacle_velocity: Array
    obstacle_angular_velocity: Array
    obstacle_present: NDArray[np.bool_]
    obstacle_size: Array
    contact_distance: Array
    contact_force: Array
    step: NDArray[np.int_]
    time: Array
    trace: Mapping[str, Array] = field(default_factory=Trace)
    previous: ArmState | None = None
    shield_correction: Array | None = None
    shield_braked: NDArray[np.bool_] | None = None

    @property
    def touched(self) -> NDArray[np.bool_]:
        """Which obstacles the arm has touched in the control step, ``(N, m)``."""
        return is_touch(self.contact_distance, self.contact_force)


def is_touch(distance: Array, force: Array) -> NDArray[np.bool_]:
    """What is a touch: bodies that overlap or push, as Bullet's do where still a hair apart."""
    return (distance <= 0) | (force > 0)
