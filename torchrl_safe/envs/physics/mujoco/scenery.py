"""What is only there to be looked at."""

from __future__ import annotations

from typing import Any

from torchrl_safe.envs.physics.mujoco.engine import mujoco

#: Name of the ball where the goal is, which comes after all other bodies.
GOAL = "goal"
_HIDDEN = 3  # A group of shapes that is not drawn.
_YELLOW, _GREY = (1.0, 0.85, 0.1, 1.0), (0.8, 0.8, 0.82, 1.0)
_BLUE_TILE, _WHITE_TILE, _SKY = (0.55, 0.65, 0.85), (0.95, 0.95, 0.97), (0.92, 0.95, 1.0)


def dress_arm(spec: Any) -> None:
    """Hides the shapes that collide wherever a link has others to show."""
    for body in spec.bodies[1:]:
        shown = [geom for geom in body.geoms if not (geom.contype or geom.conaffinity)]
        for geom in body.geoms:
            if geom.contype or geom.conaffinity:
                if shown:
                    geom.group = _HIDDEN
                else:
                    geom.rgba = _GREY


def add_scenery(spec: Any) -> None:
    """Adds floor, sky, light and the goal."""
    texture, builtin = mujoco.mjtTexture, mujoco.mjtBuiltin
    spec.add_texture(
        name="sky",
        type=texture.mjTEXTURE_SKYBOX,
        builtin=builtin.mjBUILTIN_FLAT,
        rgb1=_SKY,
        rgb2=_SKY,
        width=16,
        height=96,
    )
    spec.add_texture(
        name="floor",
        type=texture.mjTEXTURE_2D,
        builtin=builtin.mjBUILTIN_CHECKER,
        rgb1=_BLUE_TILE,
        rgb2=_WHITE_TILE,
        width=128,
        height=128,
    )
    tiles = spec.add_material(name="floor", texrepeat=(1, 1), texuniform=True)
    tiles.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "floor"
    spec.worldbody.add_geom(
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        size=(10, 10, 1),
        pos=(0, 0, -0.7),
        material="floor",
        contype=0,
        conaffinity=0,
    )
    spec.worldbody.add_light(
        pos=(1, -1, 3), dir=(-0.4, 0.4, -1), type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL
    )
    light = spec.visual.headlight
    light.ambient, light.diffuse, light.specular = (0.35,) * 3, (0.4,) * 3, (0.1,) * 3
    ball = spec.worldbody.add_body(name=GOAL, mocap=True)
    ball.add_geom(
        type=mujoco.mjtGeom.mjGEOM_SPHERE,
        size=(0.02, 0, 0),
        rgba=_YELLOW,
        contype=0,
        conaffinity=0,
    )
