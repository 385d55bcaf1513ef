"""Makes one link of those that fixed joints hold together: engines pay for every link."""

from __future__ import annotations

from xml.etree.ElementTree import Element, SubElement

import numpy as np

from torchrl_safe.envs.state import Array

_MOMENTS = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")


def merge_fixed_links(root: Element, keep: str) -> None:
    """Merges every link that a fixed joint holds into the link that holds it.

    The merged link has all shapes, and the sum of masses and inertias. It is the same body, cheaper
    to simulate. (An engine that takes the inertia of the box around a link's shapes gets another
    one.)

    Args:
        root: a URDF; changed in place.
        keep: name of a link that stays, without shapes and mass, if only to name a frame.
    """
    links = {link.get("name"): link for link in root.findall("link")}
    joints = {end_of(joint, "child"): joint for joint in root.findall("joint")}
    for name in _leaves_first(list(joints), joints):
        joint = joints[name]
        if joint.get("type") != "fixed":
            continue
        holder, frame = end_of(joint, "parent"), _frame(joint)
        _add_inertia(links[holder], links[name], frame)
        for part in [*links[name].findall("collision"), *links[name].findall("visual")]:
            _place(part, frame @ _frame(part))
            links[holder].append(part)
            links[name].remove(part)
        for child in joints.values():
            if end_of(child, "parent") == name:
                _place(child, frame @ _frame(child))
                child.find("parent").set("link", holder)  # type: ignore[union-attr]
        if name != keep:
            root.remove(links[name])
            root.remove(joint)


def _leaves_first(names: list[str], joints: dict[str, Element]) -> list[str]:
    def depth(name: str) -> int:
        return 1 + depth(end_of(joints[name], "parent")) if name in joints else 0

    return sorted(names, key=depth, reverse=True)


def _add_inertia(holder: Element, held: Element, frame: Array) -> None:
    """Adds what a link weighs, ``frame`` being where it is held, and leaves it without mass."""
    first, second = _inertia(holder, np.eye(4)), _inertia(held, frame)
    mass = first[0] + second[0]
    centre = (first[0] * first[1] + second[0] * second[1]) / mass if mass else first[1]
    tensor = sum(
        part_tensor + part_mass * (offset @ offset * np.eye(3) - np.outer(offset, offset))
        for part_mass, part_centre, part_tensor in (first, second)
        for offset in [part_centre - centre]
    )
    _set_inertia(holder, mass, centre, np.asarray(tensor))
    _set_inertia(held, 0.0, np.zeros(3), np.zeros((3, 3)))


def _inertia(link: Element, frame: Array) -> tuple[float, Array, Array]:
    """Mass, kg, centre, m, and inertia about it, kg m^2, of a link as seen from a frame."""
    inertial = link.find("inertial")
    if inertial is None:  # What engines make of it.
        return 1.0, frame[:3, 3], np.eye(3)
    pose = frame @ _frame(inertial)
    mass = float(inertial.find("mass").get("value", 0))  # type: ignore[union-attr]
    moments = inertial.find("inertia")
    tensor = np.zeros((3, 3))
    if moments is not None:
        values = [float(moments.get(name, 0)) for name in _MOMENTS]
        tensor[np.triu_indices(3)] = values
        tensor = tensor + np.triu(tensor, 1).T
    return mass, pose[:3, 3], pose[:3, :3] @ tensor @ pose[:3, :3].T


def _set_inertia(link: Element, mass: float, centre: Array, tensor: Array) -> None:
    for old in link.findall("inertial"):
        link.remove(old)
    inertial = SubElement(link, "inertial")
    SubElement(inertial, "origin", xyz=_text(centre), rpy="0 0 0")
    SubElement(inertial, "mass", value=repr(float(mass)))
    moments = tensor[np.triu_indices(3)]
    SubElement(inertial, "inertia", dict(zip(_MOMENTS, map(repr, moments.tolist()), strict=True)))


def _frame(element: Element) -> Array:
    """The ``origin`` of an element as a homogeneous matrix, (4, 4)."""
    origin = element.find("origin")
    matrix = np.eye(4)
    if origin is not None:
        matrix[:3, 3] = [float(x) for x in origin.get("xyz", "0 0 0").split()]
        roll, pitch, yaw = (float(x) for x in origin.get("rpy", "0 0 0").split())
        matrix[:3, :3] = _turn(2, yaw) @ _turn(1, pitch) @ _turn(0, roll)
    return matrix


def _place(element: Element, frame: Array) -> None:
    """Writes a homogeneous matrix into the ``origin`` of an element."""
    origin = element.find("origin")
    if origin is None:
        origin = SubElement(element, "origin")
    turn = frame[:3, :3]
    level = np.hypot(turn[0, 0], turn[1, 0])
    roll, yaw = np.arctan2(turn[2, 1], turn[2, 2]), np.arctan2(turn[1, 0], turn[0, 0])
    # Straight up or down, roll and yaw turn about the same axis: one of them is enough.
    if level < 1e-9:
        roll, yaw = np.arctan2(-turn[1, 2], turn[1, 1]), 0.0
    origin.set("xyz", _text(frame[:3, 3]))
    origin.set("rpy", _text(np.array([roll, np.arctan2(-turn[2, 0], level), yaw])))


def _turn(axis: int, angle: float) -> Array:
    first, second = (axis + 1) % 3, (axis + 2) % 3
    matrix = np.eye(3)
    matrix[first, first] = matrix[second, second] = np.cos(angle)
    matrix[first, second], matrix[second, first] = -np.sin(angle), np.sin(angle)
    return matrix


def end_of(joint: Element, side: str) -> str:
    """Name of the parent or child link of a joint."""
    link = joint.find(side)
    return "" if link is None else link.get("link", "")


def _text(values: Array) -> str:
    return " ".join(map(repr, values.tolist()))
