"""Reads an arm's URDF into a MuJoCo specification."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from torchrl_safe.envs.arms import ArmModel
from torchrl_safe.envs.arms.models import check_fingers, check_home
from torchrl_safe.envs.arms.urdf import prepare_urdf
from torchrl_safe.envs.physics.mujoco.contacts import collides, set_arm_contacts
from torchrl_safe.envs.physics.mujoco.engine import mujoco
from torchrl_safe.envs.physics.mujoco.meshes import read_meshes
from torchrl_safe.envs.state import Array

# What MuJoCo's reader of URDF files is told: keep every link, and paths as they are.
_COMPILER = {"strippath": "false", "balanceinertia": "true", "fusestatic": "false"}
# What a root link is called that has the name of MuJoCo's own.
_ROOT = "arm/world"


@dataclass(frozen=True)
class ArmParts:
    """Names of an arm's parts, and what its URDF says of them.

    Attributes:
        tool: name of the body whose frame is the tool point.
        root: name of the body that all others of the arm hang from.
        moving: name of the first body that a joint moves.
        links: names of all bodies but the base of the URDF.
        joints: names of the arm's joints, from base to tool.
        fingers: names of the other movable joints.
        joint_lower: lower limits of the arm's joints, rad.
        joint_upper: upper limits of the arm's joints, rad.
        finger_lower: lower limits of the fingers, m.
        finger_upper: upper limits of the fingers, m.
        speed: largest speeds of joints and fingers, rad/s and m/s, infinite where none is given.
        effort: largest torques and forces of joints and fingers, N m and N; likewise.
    """

    tool: str
    root: str
    moving: str
    links: tuple[str, ...]
    joints: tuple[str, ...]
    fingers: tuple[str, ...]
    joint_lower: Array
    joint_upper: Array
    finger_lower: Array
    finger_upper: Array
    speed: Array
    effort: Array


def read_arm(
    arm: ArmModel, *, fix_fingers: bool, merge: bool, couple: bool, visuals: bool, itself: bool
) -> tuple[Any, ArmParts]:
    """Returns the specification of an arm alone, an ``MjSpec``, and its parts.

    Args:
        arm: the arm.
        fix_fingers: fix every joint that does not move the tool.
        merge: make one link of those that fixed joints hold together.
        couple: let the fingers open alike, as the gear of a parallel gripper does.
        visuals: keep the shapes that are only drawn.
        itself: let links collide with each other.

    Raises:
        ValueError: if the URDF does not load or the home pose does not fit it.
    """
    text, chain, tool = prepare_urdf(arm, visuals=visuals, fix_fingers=fix_fingers, merge=merge)
    root = ElementTree.fromstring(text)
    _rename_world(root)
    meshes = read_meshes(root)
    for own in root.findall("mujoco"):  # MuJoCo takes one.
        root.remove(own)
    extension = ElementTree.SubElement(root, "mujoco")
    ElementTree.SubElement(extension, "compiler", _COMPILER, discardvisual=str(not visuals).lower())
    try:
        text = ElementTree.tostring(root, encoding="unicode")
        spec = mujoco.MjSpec.from_string(text, assets=meshes)
    except ValueError as error:
        raise ValueError(f"urdf {arm.urdf!r} does not load in MuJoCo: {error}") from error
    parts = _find_parts(spec, root, chain, tool)
    check_home(arm, parts.joint_lower, parts.joint_upper)
    _free_joints(spec, parts)
    if couple:
        check_fingers(arm, parts.finger_lower, parts.finger_upper)
        _couple(spec, parts.fingers)
    else:
        for gear in list(spec.equalities):
            spec.delete(gear)
    set_arm_contacts(spec, _frictions(root), itself=itself)
    return spec, parts


def name_solids(spec: Any) -> dict[str, str]:
    """Names the shapes of an arm that collide; returns each with the name of its body."""
    solids: dict[str, str] = {}
    for body in spec.bodies[1:]:
        for geom in body.geoms:
            if collides(geom):
                geom.name = f"arm/{len(solids)}"
                solids[geom.name] = body.name
    return solids


def _rename_world(root: ElementTree.Element) -> None:
    """Gives a root link that is called like MuJoCo's own a body to itself."""
    for element in root.iter():
        for key in ("name", "link"):
            if element.tag in ("link", "parent") and element.get(key) == "world":
                element.set(key, _ROOT)


def _find_parts(spec: Any, root: ElementTree.Element, chain: set[str], tool: str) -> ArmParts:
    movable = [joint for joint in spec.joints if joint.type != mujoco.mjtJoint.mjJNT_FREE]
    joints = [joint.name for joint in movable if joint.name in chain]
    if not joints:
        raise ValueError(f"ee_link must be a link that a joint moves, got {tool!r}.")
    fingers = [joint.name for joint in movable if joint.name not in chain]
    limits = {joint.get("name"): _limits(joint) for joint in root.findall("joint")}
    lower, upper, effort, speed = np.array([limits[name] for name in joints + fingers]).T
    moving = spec.joint(joints[0]).parent
    top = moving
    while top.parent.name != "world":
        top = top.parent
    children = {joint.find("child").get("link") for joint in root.findall("joint")}  # type: ignore[union-attr]
    count = len(joints)
    return ArmParts(
        tool=tool,
        root=top.name,
        moving=moving.name,
        links=tuple(body.name for body in spec.bodies if body.name in children),
        joints=tuple(joints),
        fingers=tuple(fingers),
        joint_lower=lower[:count],
        joint_upper=upper[:count],
        finger_lower=lower[count:],
        finger_upper=upper[count:],
        speed=speed,
        effort=effort,
    )


def _limits(joint: ElementTree.Element) -> tuple[float, float, float, float]:
    """Lower, upper, effort and speed limit, infinite where there is none."""
    limit = joint.find("limit")
    values = {} if limit is None else limit.attrib
    lower, upper = (float(values.get(name, 0)) for name in ("lower", "upper"))
    if lower >= upper or joint.get("type") == "continuous":
        lower, upper = -np.inf, np.inf
    effort, speed = (float(values.get(name, 0)) or np.inf for name in ("effort", "velocity"))
    return lower, upper, effort, speed


def _free_joints(spec: Any, parts: ArmParts) -> None:
    """Leaves to the motors what they would overcome: gravity, and the joints' friction."""
    for body in spec.bodies[1:]:
        body.gravcomp = 1
    for name in parts.joints + parts.fingers:
        joint = spec.joint(name)
        joint.damping = np.zeros_like(joint.damping)
        joint.frictionloss = 0
        joint.actfrclimited = False


def _couple(spec: Any, fingers: Sequence[str]) -> None:
    coupled = {gear.name1 for gear in spec.equalities} | {gear.name2 for gear in spec.equalities}
    for finger in fingers[1:]:
        if finger not in coupled:
            gear = spec.add_equality(
                type=mujoco.mjtEq.mjEQ_JOINT,
                objtype=mujoco.mjtObj.mjOBJ_JOINT,
                name1=finger,
                name2=fingers[0],
            )
            gear.data[:5] = (0, 1, 0, 0, 0)


def _frictions(root: ElementTree.Element) -> dict[str, float]:
    """The lateral friction of the links whose URDF gives one."""
    found = {}
    for link in root.iter("link"):
        friction = link.find("contact/lateral_friction")
        if friction is not None:
            found[link.get("name", "")] = float(friction.get("value", 0.5))
    return found
