"""Rewrites URDF files into what the physics needs and nothing more."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from pathlib import Path

_PACKAGE = "package://"


def movable_chain(root: ElementTree.Element, tip: str) -> set[str]:
    """Returns the names of the movable joints between the base and a link.

    Raises:
        ValueError: if the URDF has no link of that name.
    """
    links = [link.get("name", "") for link in root.findall("link")]
    if tip not in links:
        raise ValueError(f"ee_link must be a link of the URDF ({', '.join(links)}), got {tip!r}.")
    parents = {
        joint.find("child").get("link"): joint  # type: ignore[union-attr]
        for joint in root.findall("joint")
    }
    chain = set()
    link: str | None = tip
    while link in parents:
        joint = parents[link]
        if joint.get("type") != "fixed":
            chain.add(joint.get("name", ""))
        link = joint.find("parent").get("link")  # type: ignore[union-attr]
    return chain


def prepare_urdf(
    path: Path, ee_link: str, *, visuals: bool, fix_fingers: bool
) -> tuple[str, set[str]]:
    """Returns the text of a URDF with absolute mesh paths, and its arm's joint names.

    Args:
        path: the URDF file.
        ee_link: name of the end-effector link.
        visuals: keep the visual shapes, which cost memory and load time.
        fix_fingers: fix every joint that does not move ``ee_link``: a Panda's two fingers are
            half of the cost of a physics step.

    Raises:
        ValueError: if the file is not XML, a mesh is missing or there is no such link.
    """
    try:
        root = ElementTree.parse(path).getroot()
    except (OSError, ElementTree.ParseError) as error:
        raise ValueError(
            f"urdf must be a readable URDF file, got {str(path)!r}: {error}"
        ) from error
    if not visuals:
        for link in root.iter("link"):
            for visual in link.findall("visual"):
                link.remove(visual)
    chain = movable_chain(root, ee_link)
    if fix_fingers:
        for joint in root.findall("joint"):
            if joint.get("name") not in chain:
                joint.set("type", "fixed")
    for mesh in root.iter("mesh"):
        mesh.set("filename", str(_find_mesh(path, mesh.get("filename", ""))))
    return ElementTree.tostring(root, encoding="unicode"), chain


def _find_mesh(urdf: Path, name: str) -> Path:
    relative = name.removeprefix(_PACKAGE)
    # ROS names a mesh by its package, whose folder is some parent of the URDF's.
    for folder in [urdf.parent, *urdf.parent.parents]:
        if (folder / relative).is_file():
            return folder / relative
    raise ValueError(f"urdf {str(urdf)!r} names a mesh that does not exist: {name!r}.")
