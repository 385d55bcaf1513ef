"""What :class:`~torchrl_safe.envs.ArmEnv` asks of a physics engine, and nothing more.

Two protocols: a :class:`Physics` is the frozen object that a user passes
(``ArmEnv(physics=Bullet())``); it builds the :class:`Simulator` of an environment. Each engine
has a folder beside this file, the only place that imports it. If an engine is not
installed, :meth:`Physics.build` raises an ImportError.

Units are SI, coordinates are those of the world, orientations are quaternions (x, y, z, w). N is
the number of worlds, n of arm joints, f of free finger joints, p of objects, m of obstacles.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from torchrl_safe.envs.arms import ArmModel
from torchrl_safe.envs.obstacles import Placement
from torchrl_safe.envs.obstacles.shapes import Shape
from torchrl_safe.envs.physics.scene import Camera, Scene
from torchrl_safe.envs.state import ArmState, Array, Sensing

#: What :meth:`Simulator.save` returns: arrays by name, the worlds along the first axis of each.
Saved = Mapping[str, NDArray[Any]]


class Nearest(NamedTuple):
    """Pairs of points at which the arm and what is around it are nearest to each other.

    k worlds with r pairs each, of a convex shape of the arm that joints move and an obstacle or
    the table. Each pair of shapes has one, or some more where a simulator finds several.

    Examples:
        >>> import numpy as np
        >>> from torchrl_safe.envs import PANDA, MuJoCo, Scene
        >>> world = MuJoCo().build(PANDA, Scene(), num_envs=1, reach=1.0)
        >>> nearest = world.nearest(np.arange(1), world.state().joint_position, np.zeros((1, 0)))
        >>> bool(nearest.distance.min() > 0)  # Home is free.
        True
        >>> world.close()
    """

    #: Distance of the two points, m, ``(k, r)``; negative where the shapes overlap, infinite where
    #: there are no more pairs within reach.
    distance: Array
    #: Unit vectors from the other shape to the arm, ``(k, r, 3)``.
    normal: Array
    #: The points on the arm, m, ``(k, r, 3)``.
    point: Array
    #: By how much the distance grows with each joint and free finger, m/rad and m/m,
    #: ``(k, r, n + f)``.
    jacobian: Array
    #: Which obstacle the other shape is, ``(r,)``; m is the table.
    other: NDArray[np.int_]


class Simulator(Protocol):
    """N worlds of the same build, each with one arm on a table whose top is at height 0.

    Worlds do not depend on each other. What happens in a row is the same, bit for bit, whatever
    the other rows do, and whatever happened in this row before its last :meth:`reset`.

    Examples:
        >>> from torchrl_safe.envs import PANDA, MuJoCo, Scene
        >>> world = MuJoCo().build(PANDA, Scene(), num_envs=2)
        >>> world.state().joint_position.shape
        (2, 7)
        >>> world.close()
    """

    @property
    def joint_lower(self) -> Array:
        """Lower limits of the arm's joints, rad, ``(n,)``; -inf without limit."""

    @property
    def joint_upper(self) -> Array:
        """Upper limits of the arm's joints, rad, ``(n,)``; inf without limit."""

    @property
    def joint_speed(self) -> Array:
        """Largest speeds of the arm's joints, rad/s, ``(n,)``; inf where the URDF has none.

        ArmEnv clips targets to them, if the scene has motor limits; a simulator need not.
        """

    @property
    def finger_speed(self) -> Array:
        """Largest speeds of the free finger joints, m/s, ``(f,)``."""

    @property
    def home_position(self) -> Array:
        """Tool point at the arm's ``home``, m, ``(3,)``."""

    @property
    def home_orientation(self) -> Array:
        """Tool orientation at the arm's ``home``, ``(4,)``."""

    def reset(self, row: int, placement: Placement, goal: Array, objects: Array) -> None:
        """Begins an episode in one world; the other worlds stay as they are.

        The arm is at rest at home with its fingers at ``finger_home``. :meth:`state` then has
        this row's contact distances infinite and contact forces 0, and every substep of its
        trace as measured now; ``table_distance`` and ``self_distance`` are infinite.

        Args:
            row: number of the world.
            placement: where the obstacles are. Those not present are out of the world. A
                ``path`` moves them in every substep, with time 0 now.
            goal: target position, ``(3,)``.
            objects: centres of the objects, upright and at rest, ``(p, 3)``.
        """

    def advance(self, joints: Array, fingers: Array) -> None:
        """Takes a control step of ``frame_skip`` substeps in all worlds.

        The motors' targets move evenly from where joints and fingers are to what is given, in
        equal parts over the substeps. At the end of a control step of at least 12 substeps they
        have arrived to within 5 % of the way, if efforts and speeds allow.

        Every substep reads the contacts of arm and obstacles, and what the sensing asks for:
        contact points are those on which the substep's forces acted; everything else is as it is
        after the substep.

        Args:
            joints: joint targets, rad, ``(N, n)``.
            fingers: finger targets, m, ``(N, f)``, or ``(N, 0)`` where the action moves no
                fingers: free ones then are not driven.

        Raises:
            FloatingPointError: if the state of a world is not finite, or MuJoCo finds it unstable;
                names the row. The others have taken their step.
        """

    def state(self) -> ArmState:
        """Returns the state of all worlds after the last :meth:`advance`, or reset of a row.

        The arrays are new: later steps do not change them. ``step`` counts the control steps
        since the row's reset, and :meth:`restore` brings it back; ``time`` is
        that times ``frame_skip`` times 1/240 s.
        """

    def tool_at(self, joints: Array) -> tuple[Array, Array]:
        """Returns where the tool is at given joint angles.

        For the search of start poses, which need not be fast. It may move the arm of any
        world, so reset the worlds afterwards.

        Args:
            joints: joint angles, rad, ``(k, n)``, for any k.

        Returns:
            Tool points, m, ``(k, 3)``, and orientations, ``(k, 4)``.
        """

    def jacobian(self, joints: Array) -> Array:
        """Returns Jacobians of the tool point: rows 0 to 2 linear, 3 to 5 angular velocity.

        Part of every Cartesian step. It changes nothing in any world.

        Args:
            joints: joint angles, rad, ``(k, n)``, for any k; mostly ``state().joint_position``.

        Returns:
            Jacobians, ``(k, 6, n)``.
        """

    def clearance(self, row: int) -> float:
        """Returns how far obstacles and objects are from the arm and objects in one world.

        The smallest distance, in m, negative where they overlap; 0.1 where it is more.
        """

    def nearest(self, rows: NDArray[np.int_], joints: Array, fingers: Array) -> Nearest:
        """Measures how far the arm would be from obstacles and table, in some of the worlds.

        For the table, an engine may leave out links that only turn about vertical axes. The call
        changes nothing in any world.

        Args:
            rows: numbers of the worlds, ``(k,)``; obstacles are where they are there now.
            joints: joint angles, rad, ``(k, n)``.
            fingers: free finger joints, m, ``(k, f)``.

        Raises:
            ValueError: if the simulator was built without ``reach``.
        """

    def pictures(self, camera: Camera, width: int, height: int) -> NDArray[np.uint8]:
        """Returns an RGB picture of every world, ``(N, height, width, 3)``. Changes nothing."""

    def save(self) -> Saved:
        """Returns all that :meth:`restore` needs to bring the running episodes back.

        Plain numeric arrays, in copies, so that they can become part of a checkpoint.
        """

    def restore(self, saved: Saved) -> None:
        """Brings the saved episodes back, bit for bit, in any simulator of the same build.

        ArmEnv first calls :meth:`reset` for every row with the placement, goal and objects of
        the saved episode, which it draws again (a path is code, and not among the arrays). What
        follows here may replay the episode or set its state. Afterwards :meth:`state` returns
        what it returned when :meth:`save` was called.

        Warns if the episodes did not come back bit for bit (another version of the engine).

        Raises:
            ValueError: if the arrays are not those of a simulator of this build.
        """

    def close(self) -> None:
        """Frees what the worlds hold; may be called more than once."""


@runtime_checkable
class Physics(Protocol):
    """A physics engine with its options: a frozen object, which can be copied and pickled.

    Examples:
        >>> from torchrl_safe.envs import ArmEnv, Bullet
        >>> isinstance(Bullet(), Physics)
        True
        >>> ArmEnv(physics=Bullet()).close()
    """

    def build(
        self,
        arm: ArmModel,
        scene: Scene,
        *,
        num_envs: int,
        shapes: Sequence[Shape] = (),
        objects: Sequence[Shape] = (),
        sensing: Sensing = Sensing(),
        frame_skip: int = 12,
        reach: float | None = None,
        gui: bool = False,
    ) -> Simulator:
        """Builds the worlds of an environment.

        Args:
            arm: the arm, at home in every world.
            scene: gravity, and what holds of the motors in every engine.
            num_envs: number N of worlds.
            shapes: the m obstacles.
            objects: the p objects that the task moves.
            sensing: what is measured in every substep besides contacts.
            frame_skip: substeps of a control step, each of 1/240 s.
            reach: distance up to which :meth:`Simulator.nearest` measures, m.
            gui: show the first world in a window.

        Raises:
            ImportError: if the engine is not installed; names the extra to install.
            ValueError: if the arm's files or home pose do not fit, or the engine does not have
                what the scene asks for.
            RuntimeError: if there is no screen for ``gui``, or no room for the worlds.
        """
