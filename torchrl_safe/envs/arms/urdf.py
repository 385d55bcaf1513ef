"""Rewrites URDF files into what the physics needs, and nothing more."""

from __future__ import annotations

import importlib.metadata
import importlib.util
import math
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from torchrl_safe.envs.arms.models import ArmModel, Gripper
from torchrl_safe.envs.arms.urdf_merge import end_of, merge_fixed_links

_PACKAGE, _FILE = "package://", "file://"
# What the names of an attached gripper begin with, so that they are not those of the arm.
_PREFIX = "gripper/"
_DATA, _MORE_ARMS = "pybullet_data", "example-robot-data"


class PreparedUrdf(NamedTuple):
    """A URDF ready to be loaded."""

    #: The XML, with absolute mesh paths.
    text: str
    #: Names of the joints that move the tool.
    joints: set[str]
    #: Name of the link whose frame is the tool point.
    tool_link: str


def prepare_urdf(arm: ArmModel, *, visuals: bool, fix_fingers: bool, merge: bool) -> PreparedUrdf:
    """Returns the URDF of an arm with its gripper.

    Args:
        arm: the arm.
        visuals: keep the visual shapes, which cost memory and load time.
        fix_fingers: fix every joint that does not move the tool. A Panda's two fingers take
            half of the time of a physics step.
        merge: make one link of those that fixed joints hold together, except the tool's frame.

    Raises:
        ValueError: if a file is missing or not XML, a mesh is missing, there is no such link, or
            a joint that moves the tool mimics another.
    """
    root = _read(arm.urdf, visuals=visuals)
    tool_link = arm.ee_link
    _check_link("ee_link", root, tool_link)
    if arm.gripper is not None:
        tool_link = _attach(root, arm.ee_link, arm.gripper, visuals=visuals)
    chain = movable_chain(root, tool_link)
    for joint in root.findall("joint"):
        if joint.get("name") in chain and joint.find("mimic") is not None:
            raise ValueError(
                f"urdf {arm.urdf!r} must move each joint up to {tool_link!r} by itself, got a "
                f"mimic joint: {joint.get('name')!r}."
            )
    if fix_fingers:
        for joint in root.findall("joint"):
            if joint.get("name") not in chain:
                joint.set("type", "fixed")
    if merge:
        merge_fixed_links(root, keep=tool_link)
    return PreparedUrdf(ElementTree.tostring(root, encoding="unicode"), chain, tool_link)


def find_urdf(name: str) -> Path:
    """Returns the path of a URDF file.

    Args:
        name: path, absolute or relative to the folder of ``pybullet_data``, of the robots of
            example-robot-data where that is installed, of this package, or to the working
            directory.

    Raises:
        ValueError: if there is no such file, or several.
    """
    # An absolute name takes the place of the folder.
    found = {path.resolve(): path for folder in _folders() if (path := folder / name).is_file()}
    if len(found) > 1:
        raise ValueError(
            f"urdf must be the path of one file, got {name!r}, which is in several folders: pass "
            f"one of {[str(path) for path in found]}."
        )
    if found:
        return found.popitem()[1]
    hint = f"there is no such file in any of {[str(folder) for folder in _folders()]}"
    if str(name).partition("/")[0].endswith("_description"):
        hint += f'; the arms of {_MORE_ARMS} need `pip install "torchrl-safe[more-arms]"`'
    elif importlib.util.find_spec(_DATA) is None:
        hint += f'; the arms of {_DATA} need `pip install "torchrl-safe[arms]"`'
    raise ValueError(f"urdf must be a readable URDF file, got {name!r}: {hint}.")


def movable_chain(root: ElementTree.Element, tip: str) -> set[str]:
    """Returns the names of the movable joints between the base and a link."""
    parents = {end_of(joint, "child"): joint for joint in root.findall("joint")}
    chain = set()
    link = tip
    while link in parents:
        joint = parents[link]
        if joint.get("type") != "fixed":
            chain.add(joint.get("name", ""))
        link = end_of(joint, "parent")
    return chain


def _folders() -> Iterator[Path]:
    data = importlib.util.find_spec(_DATA)
    if data is not None and data.origin is not None:
        yield Path(data.origin).parent
    try:
        package = importlib.metadata.distribution(_MORE_ARMS)
    except importlib.metadata.PackageNotFoundError:
        pass
    else:
        yield Path(str(package.locate_file(f"cmeel.prefix/share/{_MORE_ARMS}/robots")))
    yield Path(__file__).parent
    yield Path.cwd()


def _read(name: str, *, visuals: bool) -> ElementTree.Element:
    path = find_urdf(name)
    try:
        root = ElementTree.parse(path).getroot()
    except (OSError, ElementTree.ParseError) as error:
        raise ValueError(
            f"urdf must be a readable URDF file, got {str(path)!r}: {error}"
        ) from error
    if root.tag != "robot":
        raise ValueError(
            f"urdf must be a URDF file, whose root is <robot>, got {str(path)!r}: <{root.tag}>."
        )
    if not visuals:
        for link in root.iter("link"):
            for visual in link.findall("visual"):
                link.remove(visual)
    _weigh_frames(root)
    for joint in root.findall("joint"):
        if joint.get("type") != "fixed":
            _settle(joint)
    for mesh in root.iter("mesh"):
        mesh.set("filename", str(_find_mesh(path, mesh.get("filename", ""))))
    return root


def _settle(joint: ElementTree.Element) -> None:
    """Settles what engines read differently: lengths of axes, and ranges of joints that turn."""
    if (axis := joint.find("axis")) is not None:
        values = [float(value) for value in axis.get("xyz", "1 0 0").split()]
        length = math.hypot(*values)
        if length == 0:
            raise ValueError(f"axis of joint {joint.get('name')!r} must not be zero.")
        if length != 1:
            axis.set("xyz", " ".join(str(value / length) for value in values))
    limit = joint.find("limit")
    if limit is None:
        return
    free = float(limit.get("lower", 0)) >= float(limit.get("upper", 0))
    if free and joint.get("type") == "revolute":
        joint.set("type", "continuous")
    if free or joint.get("type") == "continuous":
        for name in ("lower", "upper"):
            limit.attrib.pop(name, None)


def _weigh_frames(root: ElementTree.Element) -> None:
    # A link without inertia only names a frame, but an engine may give it 1 kg.
    fixed = {end_of(j, "child") for j in root.findall("joint") if j.get("type") == "fixed"}
    for link in root.findall("link"):
        if link.get("name") in fixed and link.find("inertial") is None:
            inertial = ElementTree.SubElement(link, "inertial")
            ElementTree.SubElement(inertial, "mass", value="0")
            zeros = dict.fromkeys(("ixx", "ixy", "ixz", "iyy", "iyz", "izz"), "0")
            ElementTree.SubElement(inertial, "inertia", zeros)


def _attach(arm: ElementTree.Element, ee_link: str, gripper: Gripper, *, visuals: bool) -> str:
    """Adds a gripper to the URDF of an arm; returns the name that its tool link has there."""
    root = _read(gripper.urdf, visuals=visuals)
    _check_link("tool_link", root, gripper.tool_link)
    children = {end_of(joint, "child") for joint in root.findall("joint")}
    palm = next(name for name in _link_names(root) if name not in children)
    for element in root.iter():
        for key in ("name", "link", "joint"):
            if key in element.attrib:
                element.set(key, _PREFIX + element.attrib[key])
    mount = ElementTree.SubElement(arm, "joint", name=f"{_PREFIX}mount", type="fixed")
    ElementTree.SubElement(mount, "parent", link=ee_link)
    ElementTree.SubElement(mount, "child", link=_PREFIX + palm)
    xyz, rpy = (" ".join(map(str, values)) for values in (gripper.position, gripper.rotation))
    ElementTree.SubElement(mount, "origin", xyz=xyz, rpy=rpy)
    arm.extend(root)
    return _PREFIX + gripper.tool_link


def _check_link(argument: str, root: ElementTree.Element, name: str) -> None:
    links = _link_names(root)
    if name not in links:
        raise ValueError(
            f"{argument} must be a link of the URDF ({', '.join(links)}), got {name!r}."
        )


def _link_names(root: ElementTree.Element) -> list[str]:
    return [link.get("name", "") for link in root.findall("link")]


def _find_mesh(urdf: Path, name: str) -> Path:
    relative = name.removeprefix(_PACKAGE).removeprefix(_FILE)
    # ROS names a mesh by its package, whose folder is some parent of the URDF's.
    for folder in [urdf.parent, *urdf.parent.parents]:
        if (folder / relative).is_file():
            return folder / relative
    raise ValueError(f"urdf {str(urdf)!r} names a mesh that does not exist: {name!r}.")
