"""Draws environments, with what is in them named: ``make gallery``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import tyro
from matplotlib.axes import Axes
from matplotlib.patheffects import withStroke
from numpy.typing import NDArray
from tqdm import tqdm

from experiments.config import Engine
from experiments.environment import PHYSICS
from experiments.film import project
from experiments.style import INK, figure_style
from torchrl_safe.envs import ArmEnv, ArmState, Camera, Human, Moving
from torchrl_safe.envs.gym import combination

#: From the side, so that neither the arm nor the person hides the table.
CAMERA = Camera(eye=(0.55, -1.5, 0.8), target=(0.47, 0.0, 0.23), field_of_view=35, shadows=True)
#: From the other end of the table: cube and goal are beside each other as the robot sees them.
ACROSS = Camera(eye=(1.55, -0.85, 0.8), target=(0.42, 0.0, 0.18), field_of_view=38, shadows=True)
#: From the side, with room for a person.
WITH_PERSON = Camera(
    eye=(0.75, -1.8, 0.9), target=(0.66, 0.0, 0.27), field_of_view=40, shadows=True
)
#: Arm, task and obstacles of each picture, as in the names of the Gymnasium environments, and a
#: seed with which nothing hides anything.
SCENES = (
    ("Panda", "Reach", "InFront", 0),
    ("Iiwa", "Push", "Scattered", 20),
    ("XArm7", "PickAndPlace", "InFront", 9),
    ("UR5", "Reach", "Human", 3),
    ("XArm6", "Push", "Moving", 9),
    ("UR10", "PickAndPlace", "Human", 1),
)
#: The pictures of the pages of the tasks, by their file names.
TASK_SCENES = {
    "reach": ("Panda", "Reach", "InFront", 22),
    "push": ("Panda", "Push", "InFront", 15),
    "pick_and_place": ("Panda", "PickAndPlace", "InFront", 15),
}
_COLUMNS = 3


@dataclass(frozen=True)
class Config:
    """Draw six environments, and each task."""

    physics: Engine = "mujoco"
    """Engine that simulates and draws them."""
    out: Path = Path("runs/gallery.png")
    """File of the six; the pictures of the tasks are put beside it."""
    width: int = 420
    """Width of each tile in pixels; its height is three quarters of that."""
    steps: int = 14
    """Control steps before the picture is taken, in which the arm stays where it is."""


def main(config: Config) -> None:
    """Draws and saves the gallery, and beside it the pictures of the tasks."""
    config.out.parent.mkdir(parents=True, exist_ok=True)
    size = (config.width, config.width * 3 // 4)
    rows = -(-len(SCENES) // _COLUMNS)
    with figure_style():
        figure, grid = plt.subplots(
            rows,
            _COLUMNS,
            figsize=(_COLUMNS * size[0] / 100, rows * (size[1] + 26) / 100),
            layout="constrained",
        )
        scenes = tqdm(SCENES, desc="gallery", unit="picture")
        for axis, (*parts, seed) in zip(grid.flat, scenes, strict=True):
            draw(axis, parts, seed, config, size)
        figure.savefig(config.out, dpi=100)
        plt.close(figure)
        for name, (*parts, seed) in TASK_SCENES.items():
            figure, axis = plt.subplots(figsize=(size[0] / 75, size[1] / 75), layout="constrained")
            draw(axis, parts, seed, config, size)
            axis.set_title("")
            figure.savefig(config.out.with_name(f"{name}.png"), dpi=100)
            plt.close(figure)


def draw(
    axis: Axes, parts: Sequence[str], seed: int, config: Config, size: tuple[int, int]
) -> None:
    """Draws an environment into an axis and names what is to be seen."""
    arm, task, obstacles = parts
    env = ArmEnv(
        **combination(arm, task, obstacles, ""), physics=PHYSICS[config.physics], seed=seed
    )
    env.rollout(config.steps, lambda td: td.set("action", env.action_spec.zero()))
    if isinstance(env.obstacles, Human):
        camera = WITH_PERSON
    else:
        camera = ACROSS if env.task.objects else CAMERA
    twice = (2 * size[0], 2 * size[1])
    axis.imshow(env.render(*twice, camera)[0].numpy(), extent=(0, size[0], size[1], 0))
    things = names(env.arm_state, env)
    env.close()
    axis.set_axis_off()
    axis.set_title(arm + task + obstacles, color=INK)
    for (name, aside), place in things.items():
        x, y = project(place[None], camera, size)[0]
        note = axis.annotate(
            name,
            (x, y),
            xytext=aside,
            textcoords="offset points",
            ha="center",
            va="center",
            fontsize=10,
            fontweight="bold",
            color=INK,
            path_effects=[withStroke(linewidth=3, foreground="white")],
            arrowprops={"arrowstyle": "-", "color": INK, "lw": 1, "shrinkB": 4},
        )
        note.set_in_layout(False)


def names(state: ArmState, env: ArmEnv) -> dict[tuple[str, tuple[int, int]], NDArray[Any]]:
    """Where the named things are, m, by their names and where these stand beside them, points."""
    found = {("goal", (26, -30)): state.goal[0]}
    if state.object_position.shape[1]:
        found[("cube", (38, -12))] = state.object_position[0, 0]
    places = state.obstacle_position[0, state.obstacle_present[0]]
    if isinstance(env.obstacles, Human):
        found[("person", (-42, 14))] = places[-1]
    elif len(places):
        name = "moving obstacle" if isinstance(env.obstacles, Moving) else "obstacle"
        found[(name, (58, 28))] = places[places[:, 0].argmax()]
    return found


if __name__ == "__main__":
    main(tyro.cli(Config))
