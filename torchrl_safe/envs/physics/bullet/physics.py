"""PyBullet as an argument of an environment."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from torchrl_safe._checks import check_array, check_flag, check_kind, check_positive
from torchrl_safe.envs.arms import ArmModel
from torchrl_safe.envs.obstacles.shapes import Shape
from torchrl_safe.envs.physics.bullet.simulator import BulletSimulator
from torchrl_safe.envs.physics.scene import Scene
from torchrl_safe.envs.state import Sensing


@dataclass(frozen=True)
class Bullet:
    """Physics by PyBullet (the ``arms`` extra): every world is a server of its own.

    The defaults are the fastest that are correct. The other values are for the paper's environment.

    Args:
        furniture: URDF files of ``pybullet_data`` with their positions. Empty gives a table
            whose top is at height 0.
        target_urdf: body of the target, a file of ``pybullet_data``, free to move; the goal is
            then read from the simulator. With ``None`` the target is a point.
        merged_links: simulate links that fixed joints hold together as one link, with the contact
            properties of the first: a physics step takes 15 to 40 % less time. With
            ``urdf_inertia`` it is the same body; otherwise its inertia is that of another box.
            It has no effect if the task moves objects, whose grip depends on these properties.
        motor_gain: if given, the motors go this share of the remaining way to their targets in
            each physics substep. With 1/12 and 12 substeps they have gone 65 % of the way at the
            end of a control step. ``None`` moves the targets evenly, see
            :class:`~torchrl_safe.envs.ActionMode`.
        urdf_inertia: take inertias from the URDF instead of from the collision shapes.
        fresh_links: read the tool pose of the current joint angles. ``False`` reads it one
            physics substep late, as PyBullet does by default.

    Raises:
        TypeError: if a flag is not True or False, or a file or its position is none.
        ValueError: if ``motor_gain`` is not a share, or a position is not three finite numbers. A
            file that does not load raises it where the world is built.

    Examples:
        >>> Bullet(motor_gain=0.1).merged_links
        True
    """

    furniture: tuple[tuple[str, tuple[float, float, float]], ...] = ()
    target_urdf: str | None = None
    merged_links: bool = True
    motor_gain: float | None = None
    urdf_inertia: bool = False
    fresh_links: bool = True

    def __post_init__(self) -> None:
        if self.motor_gain is not None:
            check_positive(motor_gain=self.motor_gain)
            if self.motor_gain > 1:
                raise ValueError(f"motor_gain must be at most 1, got {self.motor_gain}.")
        check_kind("furniture", self.furniture, Sequence)
        for each in self.furniture:
            if not isinstance(each, tuple | list) or len(each) != 2 or not isinstance(each[0], str):
                raise TypeError(f"furniture must be pairs of a file and a position, got {each!r}.")
            check_array("position of furniture", each[1], (3,))
        if self.target_urdf is not None:
            check_kind("target_urdf", self.target_urdf, str)
        check_flag(
            merged_links=self.merged_links,
            urdf_inertia=self.urdf_inertia,
            fresh_links=self.fresh_links,
        )

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
    ) -> BulletSimulator:
        """Builds the worlds, see :class:`~torchrl_safe.envs.Physics`."""
        return BulletSimulator(
            self,
            arm,
            scene,
            num_envs=num_envs,
            shapes=shapes,
            objects=objects,
            sensing=sensing,
            frame_skip=frame_skip,
            reach=reach,
            gui=gui,
        )
