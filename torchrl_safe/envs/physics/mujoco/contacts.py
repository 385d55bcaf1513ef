"""What touches what, and how: filters, friction and stiffness of contacts."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from torchrl_safe.envs.physics.mujoco.engine import mujoco
from torchrl_safe.envs.physics.scene import SUBSTEP

# Who may touch whom: the arm, what stays where it is put, and what physics moves.
_ARM, _FIXED, _FREE = 1, 2, 4
#: Friction of everything whose URDF gives none. PyBullet multiplies those of the two that touch;
#: MuJoCo takes the larger, or that of the shape with the higher priority: here the product.
_FRICTION = 0.5
# Friction against turning on the spot and rolling, m: that of a fingertip, and almost none.
_SPIN, _ROLL = 0.005, 1e-4
#: As stiff as the step allows, and without bouncing: time constant, s, and damping ratio.
STIFF = (2 * SUBSTEP, 1.0)


def set_options(spec: Any, gravity: float, *, standing: bool) -> None:
    """Chooses how the world is simulated.

    The integrator sees the stiffness of motors and contacts together; with another one the fingers
    of a gripper drop what they hold.

    Args:
        spec: the world; changed in place.
        gravity: m/s^2, downwards.
        standing: whether physics moves a cylinder, which stands still on several contact points
            only.
    """
    option = spec.option
    option.timestep = SUBSTEP
    option.gravity = (0, 0, -gravity)
    option.integrator = mujoco.mjtIntegrator.mjINT_DISCRETE
    option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    option.impratio = 10
    # Show a state that has gone wrong instead of replacing it.
    option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
    # Where MuJoCo 4.0 looks for several points, normals and depths of overlaps of a mesh with a
    # cylinder or a capsule can be wrong.
    if not standing:
        option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_MULTICCD)


def collides(geom: Any) -> bool:
    """Whether a shape is more than drawn."""
    return bool(geom.contype or geom.conaffinity)


def set_arm_contacts(spec: Any, frictions: Mapping[str, float], *, itself: bool) -> None:
    """Makes the shapes of an arm collide, with each other if wanted.

    Args:
        spec: the arm.
        frictions: lateral friction of the links that have one of their own.
        itself: let links collide with each other.
    """
    for body in spec.bodies[1:]:
        own = frictions.get(body.name)
        for geom in body.geoms:
            if collides(geom):
                _set(geom, _ARM, _FIXED | _FREE | (_ARM if itself else 0))
                if own is not None:
                    geom.friction = (_FRICTION * own, _SPIN, _ROLL)
                    geom.priority = 1
    for gear in spec.equalities:
        gear.solref = STIFF
    for joint in spec.joints:
        joint.solref_limit = STIFF


def set_contacts(geom: Any, *, free: bool, reach: float) -> None:
    """Makes the shape of an obstacle, an object or the table collide.

    Args:
        geom: the shape.
        free: whether physics moves it.
        reach: distance from which on contacts are found, m; forces begin at a touch.
    """
    _set(geom, _FREE if free else _FIXED, _ARM | _FREE | (_FIXED if free else 0))
    geom.gap = reach


def _set(geom: Any, kind: int, others: int) -> None:
    geom.contype, geom.conaffinity = kind, others
    geom.condim = 4
    geom.friction = (_FRICTION**2, _SPIN, _ROLL)
    geom.solref = STIFF
    geom.margin = 0.0


def exclude_overlaps(spec: Any, arm: set[str], model: Any, states: Iterable[Any]) -> None:
    """Excludes collisions of neighbouring links, and of links that touch in one of some states.

    The collision shapes of neighbours overlap. MuJoCo does not test parents against children,
    unless the parent does not move.

    Args:
        spec: the world; changed in place.
        arm: names of the arm's bodies.
        model: the world as it is, compiled.
        states: states of it, with contacts, in which links may touch.
    """
    pairs = set()
    for data in states:
        touching = model.geom_bodyid[data.contact.geom[data.contact.dist <= 0]]
        pairs |= {tuple(sorted(model.body(i).name for i in pair)) for pair in touching}
    for body in arm:
        parent = model.body(model.body(body).parentid[0]).name
        pairs.add(tuple(sorted((body, parent))))
    for one, other in sorted(pairs):
        if one in arm and other in arm:
            spec.add_exclude(bodyname1=one, bodyname2=other)


def exclude_unreachable(spec: Any, arm: set[str], model: Any, data: Any, *, reach: float) -> None:
    """Excludes tests of links against the table that cannot get near it.

    It saves time and changes nothing else. The bounding sphere of the table contains the arm, and
    the slowest tests are those near the base, where a Panda's first two links can never touch
    anything.

    Args:
        spec: the world; changed in place.
        arm: names of the arm's bodies.
        model: the world as it is, compiled.
        data: its state at home.
        reach: distance from which on contacts with the table are found, m.
    """
    level = level_bodies(model, data)
    for body in range(1, model.nbody):
        if model.body_parentid[body] not in level or not _only_turns(model, body):
            continue
        shapes = model.geom_bodyid == body
        radii = np.linalg.norm(model.geom_pos[shapes], axis=1) + model.geom_rbound[shapes]
        name = model.body(body).name
        if name in arm and data.xpos[body, 2] - radii.max(initial=0) > reach:
            spec.add_exclude(bodyname1="world", bodyname2=name)


def level_bodies(model: Any, data: Any) -> set[int]:
    """Returns the bodies that never rise or sink: at most they turn about vertical axes.

    Args:
        model: the world, compiled.
        data: any state of it.
    """
    level = {0}
    for body in range(1, model.nbody):
        upright = (np.abs(data.xaxis[_joints(model, body), 2]) > 1 - 1e-9).all()
        if model.body_parentid[body] in level and _only_turns(model, body) and upright:
            level.add(body)
    return level


def _only_turns(model: Any, body: int) -> bool:
    kinds = model.jnt_type[_joints(model, body)]
    return bool((kinds == mujoco.mjtJoint.mjJNT_HINGE).all())


def _joints(model: Any, body: int) -> slice:
    first, count = model.body_jntadr[body], model.body_jntnum[body]
    return slice(first, first + count) if count else slice(0)
