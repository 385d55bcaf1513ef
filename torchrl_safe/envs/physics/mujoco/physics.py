"""MuJoCo as an argument."""

from __future__ import annotations

import multiprocessing
from collections.abc import Sequence
from dataclasses import dataclass

from torchrl_safe._checks import check_count
from torchrl_safe._cores import cores
from torchrl_safe.envs.arms import ArmModel
from torchrl_safe.envs.obstacles.shapes import Shape
from torchrl_safe.envs.physics.mujoco.engine import mujoco
from torchrl_safe.envs.physics.mujoco.simulator import MuJoCoSimulator
from torchrl_safe.envs.physics.scene import Scene
from torchrl_safe.envs.state import Sensing


@dataclass(frozen=True)
class MuJoCo:
    """MuJoCo 4: all worlds in one batch, on several threads, several times as fast as PyBullet.

    Args:
        threads: threads that the worlds are shared between. ``None`` takes a thread for each core
            that this process may use, and a single one in a worker process. The results
            do not depend on the number, bit for bit.

    Raises:
        ValueError: if ``threads`` is not a whole number of at least 1.

    Examples:
        >>> MuJoCo(threads=2)
        MuJoCo(threads=2)
    """

    threads: int | None = None

    def __post_init__(self) -> None:
        if self.threads is not None:
            check_count(threads=self.threads)

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
    ) -> MuJoCoSimulator:
        """Builds the worlds of an environment."""
        if gui:
            raise ValueError(
                "gui must be False and render_mode not 'human' with MuJoCo, which has no window "
                "here: use render."
            )
        mujoco.MjSpec  # noqa: B018  (says so if it is missing)
        return MuJoCoSimulator(
            arm,
            scene,
            threads=self.threads or _cores(),
            num_envs=num_envs,
            shapes=shapes,
            objects=objects,
            sensing=sensing,
            frame_skip=frame_skip,
            reach=reach,
        )


def _cores() -> int:
    """Cores that are ours; a worker has one."""
    return 1 if multiprocessing.parent_process() is not None else cores()
