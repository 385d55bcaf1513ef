"""What is drawn and not simulated."""

from __future__ import annotations

from typing import Any

from torchrl_safe.envs.physics.mujoco.contacts import collides
from torchrl_safe.envs.physics.mujoco.engine import mujoco
from torchrl_safe.envs.physics.palette import (
    ARM,
    FLOOR,
    GOAL as GOAL_COLOUR,
    GOAL_RADIUS,
    SKY,
    ring,
)
from torchrl_safe.envs.physics.scene import FLOOR_HEIGHT, FLOOR_SIZE

#: Name of the ball where the goal is, which comes after all other bodies.
GOAL = "scene/goal"
_HIDDEN = 3  # A group of shapes that is not drawn.


def dress_arm(spec: Any) -> None:
    """Hides the shapes that collide wherever a link has others to show."""
    for body in spec.bodies[1:]:
        shown = [geom for geom in body.geoms if not collides(geom)]
        for geom in body.geoms:
            if collides(geom):
                if shown:
                    geom.group = _HIDDEN
                else:
                    geom.rgba = ARM


def add_scenery(spec: Any) -> None:
    """Adds floor, sky, light and the goal."""
    spec.add_texture(
        name="sky",
        type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_FLAT,
        rgb1=SKY[:3],
        rgb2=SKY[:3],
        width=16,
        height=96,
    )
    unseen = {"contype": 0, "conaffinity": 0}
    spec.worldbody.add_geom(
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        size=(FLOOR_SIZE, FLOOR_SIZE, 1),
        pos=(0, 0, FLOOR_HEIGHT),
        rgba=FLOOR,
        **unseen,
    )
    spec.worldbody.add_light(
        pos=(1.5, -1.5, 3),
        dir=(-0.5, 0.5, -1),
        type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
        diffuse=(0.45,) * 3,
        specular=(0.1,) * 3,
    )
    light = spec.visual.headlight
    light.ambient, light.diffuse, light.specular = (0.42,) * 3, (0.2,) * 3, (0.0,) * 3
    goal = spec.worldbody.add_body(name=GOAL, mocap=True)
    vertices, triangles = ring()
    spec.add_mesh(name=GOAL, uservert=vertices.ravel(), userface=triangles.ravel())
    ball = {"type": mujoco.mjtGeom.mjGEOM_SPHERE, "size": (GOAL_RADIUS, 0, 0)}
    for shape in (ball, {"type": mujoco.mjtGeom.mjGEOM_MESH, "meshname": GOAL}):
        goal.add_geom(rgba=GOAL_COLOUR, **shape, **unseen)
