"""Costs: callables that map an ArmState to one number for each world.

Each is read over **all** physics substeps of a control step. A cost that needs more than
contacts says so by :attr:`~torchrl_safe.envs.state.Sensor.sensing`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from torchrl_safe._checks import check_flag, check_kind, check_not_negative, check_positive
from torchrl_safe.envs.regions import Region
from torchrl_safe.envs.state import ArmState, Array, Sensing


@dataclass(frozen=True)
class Collision:
    r"""Costs 1 for every control step in which the arm touches something, else 0.

    .. math::
        c = \mathbb{1}[\min_{t, i} d_{t,i} \le \text{margin}]

    with d the distance (m) between the arm and obstacle i in physics substep t. A touch that begins
    and ends between two control steps counts too. (Without a margin, the engine's contacts
    decide. They are found at the beginning of a substep, so the very last state of an episode is
    not checked.) Kovač & Farkaš 2023 and Safety Gym (Ray et al. 2019) use this cost.

    Args:
        margin: distance from an obstacle that counts as a touch, m. It is measured, which takes
            time, and from the base of the arm too.
        table: count touches of the table too (not of what the base stands on).
        itself: count links of the arm that touch each other. Those that touch at home, or with the
            gripper fully open or closed, never count. Links then collide; without it they pass
            through each other.

    Raises:
        ValueError: if ``margin`` is negative or not finite.

    Examples:
        >>> Collision(table=True)
        Collision(margin=0.0, table=True, itself=False)
    """

    margin: float = 0.0
    table: bool = False
    itself: bool = False

    def __post_init__(self) -> None:
        check_not_negative(margin=self.margin)
        check_flag(table=self.table, itself=self.itself)

    @property
    def sensing(self) -> Sensing:
        return Sensing(clearance=self.margin, table=self.table, itself=self.itself)

    def __call__(self, state: ArmState) -> Array:
        """Returns the cost of each world, shape ``(N,)``."""
        touches = state.touched.any(axis=1)
        if self.margin:
            touches |= (state.trace["clearance"] <= self.margin).any(axis=(1, 2))
        if self.table:
            touches |= (state.trace["table_distance"] <= 0).any(axis=1)
        if self.itself:
            touches |= (state.trace["self_distance"] <= 0).any(axis=1)
        return touches.astype(float)


@dataclass(frozen=True)
class ContactForce:
    r"""Costs 1 for every control step in which the arm presses an obstacle too hard, else 0.

    .. math::
        c = \mathbb{1}[\max_{t, i} F_{t,i} > \text{limit}]

    with F the sum of the normal forces (N) at the contact points between the arm and obstacle i
    in physics substep t. Obstacles that move on a path yield to nothing: their force is what it
    takes to push the arm out of the way, whatever their mass.

    Args:
        limit: N. The default is the quasi-static limit for hands and fingers of ISO/TS
            15066:2016, table A.2. (The standard allows more for less than half a second.)

    Raises:
        ValueError: if ``limit`` is negative or not finite.

    Examples:
        >>> ContactForce(limit=65.0)  # the face, in the same table
        ContactForce(limit=65.0)
    """

    limit: float = 140.0

    def __post_init__(self) -> None:
        check_not_negative(limit=self.limit)

    def __call__(self, state: ArmState) -> Array:
        """Returns the cost of each world, shape ``(N,)``."""
        return (state.contact_force > self.limit).any(axis=1).astype(float)


@dataclass(frozen=True)
class Proximity:
    r"""How far obstacles reach into a margin around the arm, in metres.

    .. math::
        c = \max_{t, i} \max(0, \text{margin} - d_{t,i})

    with d the distance (m) between the surfaces of arm and obstacle i in physics substep t,
    negative where they overlap. The cost is dense, and zero beyond the margin. It is the hinge of
    TrajOpt (Schulman et al. 2013, Robotics: Science and Systems).

    Args:
        margin: distance at which the cost begins, m.

    Raises:
        ValueError: if ``margin`` is not positive.

    Examples:
        >>> Proximity(margin=0.1).sensing.clearance
        0.1
    """

    margin: float = 0.05

    def __post_init__(self) -> None:
        check_positive(margin=self.margin)

    @property
    def sensing(self) -> Sensing:
        return Sensing(clearance=self.margin)

    def __call__(self, state: ArmState) -> Array:
        """Returns the cost of each world, m, shape ``(N,)``."""
        return np.maximum(0, self.margin - state.trace["clearance"]).max(axis=(1, 2), initial=0)


@dataclass(frozen=True)
class JointLimit:
    r"""Costs 1 for every control step in which a joint comes near its limits, else 0.

    .. math::
        c = \mathbb{1}[\min_{t, j} \min(q_{t,j} - l_j, u_j - q_{t,j}) < \text{margin}]

    with l and u the limits (rad) in the URDF of joint j and q its angle in physics substep t: the
    soft axis limiting of ISO 10218-1, as a cost.

    Args:
        margin: rad.

    Raises:
        ValueError: if ``margin`` is negative or not finite.

    Examples:
        >>> JointLimit(margin=0.1)
        JointLimit(margin=0.1)
    """

    margin: float = 0.05

    def __post_init__(self) -> None:
        check_not_negative(margin=self.margin)

    @property
    def sensing(self) -> Sensing:
        return Sensing(joints=True)

    def __call__(self, state: ArmState) -> Array:
        """Returns the cost of each world, shape ``(N,)``."""
        angles = state.trace["joint_position"]
        room = np.minimum(angles - state.joint_lower, state.joint_upper - angles)
        return (room < self.margin).any(axis=(1, 2)).astype(float)


@dataclass(frozen=True)
class Speed:
    r"""Costs 1 for every control step in which the arm is too fast, else 0.

    .. math::
        c = \mathbb{1}[\max_t |v_t| > \text{limit}]

    with v the velocity (m/s) of the tool point in physics substep t, or of the centre of mass of
    the fastest link as well. The form is that of Safety-Gymnasium's velocity tasks (Ji et al.
    2023, arXiv 2310.12567).

    Args:
        limit: m/s. The default is the reduced speed of ISO 10218-1.
        any_link: look at every link's centre of mass too.

    Raises:
        ValueError: if ``limit`` is negative or not finite.

    Examples:
        >>> Speed(limit=0.5).sensing
        Sensing(clearance=0.0, table=False, itself=False, joints=False, tool=True, links=False)
    """

    limit: float = 0.25
    any_link: bool = False

    def __post_init__(self) -> None:
        check_not_negative(limit=self.limit)
        check_flag(any_link=self.any_link)

    @property
    def sensing(self) -> Sensing:
        return Sensing(tool=True, links=self.any_link)

    def __call__(self, state: ArmState) -> Array:
        """Returns the cost of each world, shape ``(N,)``."""
        fastest = np.linalg.norm(state.trace["ee_velocity"], axis=2).max(axis=1)
        if self.any_link:
            fastest = np.maximum(fastest, state.trace["link_speed"].max(axis=(1, 2)))
        return (fastest > self.limit).astype(float)


@dataclass(frozen=True)
class SpeedAndSeparation:
    r"""Costs 1 for every control step in which the arm could not stop in time, else 0.

    Speed and separation monitoring after ISO/TS 15066:2016, 5.5.4: in every physics substep the
    distance d (m) to each obstacle must be at least the protective separation distance

    .. math::
        S = v_h (T_r + T_s) + v_r T_r + \tfrac12 v_r T_s + C

    with v_h and v_r the speeds (m/s, not less than 0) at which the closest points of obstacle
    and arm move towards each other: during the reaction time T_r both go on, during the stopping
    time T_s the arm brakes evenly. C stands for the intrusion distance and the uncertainties of
    position together.

    Args:
        reaction_time: T_r, s.
        stopping_time: T_s, s.
        intrusion: C, m.
        horizon: distance up to which obstacles are measured, m; larger takes longer. What is
            further away never costs, so choose more than S at the largest speeds that occur. The
            default is enough for the default times and 0.9 m/s of both.

    Raises:
        ValueError: if an argument is negative or not finite, or ``horizon`` is not larger than
            ``intrusion``.

    Examples:
        >>> SpeedAndSeparation(reaction_time=0.05, stopping_time=0.2).horizon
        0.5
    """

    reaction_time: float = 0.1
    stopping_time: float = 0.2
    intrusion: float = 0.05
    horizon: float = 0.5

    def __post_init__(self) -> None:
        check_not_negative(
            reaction_time=self.reaction_time,
            stopping_time=self.stopping_time,
            intrusion=self.intrusion,
            horizon=self.horizon,
        )
        if self.horizon <= self.intrusion:
            raise ValueError(
                f"horizon must be larger than intrusion = {self.intrusion}, got {self.horizon}."
            )

    @property
    def sensing(self) -> Sensing:
        return Sensing(clearance=self.horizon)

    def __call__(self, state: ArmState) -> Array:
        """Returns the cost of each world, shape ``(N,)``."""
        arm = np.maximum(0, state.trace["arm_approach"])
        obstacle = np.maximum(0, state.trace["obstacle_approach"])
        needed = (
            obstacle * (self.reaction_time + self.stopping_time)
            + arm * (self.reaction_time + self.stopping_time / 2)
            + self.intrusion
        )
        # A cost beside this one may have measured further.
        clearance = state.trace["clearance"]
        return ((clearance < needed) & (clearance <= self.horizon)).any(axis=(1, 2)).astype(float)


@dataclass(frozen=True)
class Workspace:
    r"""Costs 1 for every control step in which the tool point leaves a box, else 0.

    .. math::
        c = \mathbb{1}[\exists t: x_t \notin \text{region}]

    with x the tool point (m) in physics substep t: the soft space limiting of ISO 10218-1, as a
    cost.

    Args:
        region: where the tool may be.

    Raises:
        TypeError: if ``region`` is not a Region.

    Examples:
        >>> Workspace(Region((0.2, -0.4, 0.0), (0.8, 0.4, 0.6))).sensing.tool
        True
    """

    region: Region

    def __post_init__(self) -> None:
        check_kind("region", self.region, Region)

    @property
    def sensing(self) -> Sensing:
        return Sensing(tool=True)

    def __call__(self, state: ArmState) -> Array:
        """Returns the cost of each world, shape ``(N,)``."""
        return (~self.region.contains(state.trace["ee_position"])).any(axis=1).astype(float)


@dataclass(frozen=True)
class ShieldCorrection:
    r"""By how much the shield has changed the action, in radians.

    .. math::
        c = |q_\text{executed} - q_\text{asked}|

    with q the joint targets (rad) of the control step. Limit it to train a policy that does not
    rely on the :class:`~torchrl_safe.envs.Shield` and is safe without it.

    Args:
        margin: corrections up to this size cost nothing, rad.

    Raises:
        ValueError: if ``margin`` is negative or not finite, or in an environment without a
            shield.

    Examples:
        >>> ShieldCorrection(margin=0.01)
        ShieldCorrection(margin=0.01)
    """

    margin: float = 0.0

    def __post_init__(self) -> None:
        check_not_negative(margin=self.margin)

    def __call__(self, state: ArmState) -> Array:
        """Returns the cost of each world, rad, shape ``(N,)``."""
        if state.shield_correction is None:
            raise ValueError("shield must be given to ArmEnv for ShieldCorrection, got None.")
        return np.maximum(0, state.shield_correction - self.margin)
