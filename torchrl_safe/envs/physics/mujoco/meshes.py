"""Mesh files in a form that MuJoCo reads."""

from __future__ import annotations

from copy import deepcopy
from functools import lru_cache
from pathlib import Path
from xml.etree.ElementTree import Element

# What begins another object in a Wavefront file.
_OBJECT = ("o", "g")


def read_meshes(root: Element) -> dict[str, bytes]:
    """Returns the Wavefront files of a URDF by the names that the URDF has for them afterwards.

    PyBullet makes a convex hull of each object in a file, MuJoCo reads only the first. So each
    object becomes a shape of its own. COLLADA files, which MuJoCo cannot read, are left out. If a
    link has nothing else to show, its collision shapes are drawn.

    Args:
        root: a URDF with the paths of its meshes; changed in place.

    Raises:
        ValueError: if a shape that collides is a COLLADA file, or has no faces.
    """
    files: dict[str, bytes] = {}
    for link in root.iter("link"):
        for kind in ("visual", "collision"):
            for shape in link.findall(kind):
                mesh = shape.find("geometry/mesh")
                if mesh is None:
                    continue
                file = Path(mesh.get("filename", ""))
                if file.suffix.lower() == ".dae":
                    if kind == "collision":
                        raise ValueError(f"MuJoCo cannot read {str(file)!r}.")
                    link.remove(shape)
                elif file.suffix.lower() == ".obj":
                    link.remove(shape)
                    objects = _objects(file.read_text(errors="replace"))
                    if kind == "collision" and not objects:
                        raise ValueError(f"{str(file)!r} must have faces, got none.")
                    for text in objects:
                        name = f"mesh-{len(files)}.obj"
                        files[name] = text
                        mesh.set("filename", name)
                        link.append(deepcopy(shape))
    return files


@lru_cache(maxsize=64)
def _objects(text: str) -> list[bytes]:
    """The objects of a Wavefront file, each with its corners and faces only.

    Cached, because reading the meshes took a quarter of the time to make an environment.
    """
    corners: list[str] = []
    objects: list[list[list[int]]] = [[]]
    for line in text.splitlines():
        kind, *rest = line.split() or [""]
        if kind == "v":
            corners.append(" ".join([kind, *rest]))
        elif kind in _OBJECT:
            objects.append([])
        elif kind == "f":
            # A corner can be corner/texture/normal, and count from the last.
            numbers = [int(corner.partition("/")[0]) for corner in rest]
            objects[-1].append([n - 1 if n > 0 else len(corners) + n for n in numbers])
    return [_write(corners, faces) for faces in objects if faces]


def _write(corners: list[str], faces: list[list[int]]) -> bytes:
    used = sorted({number for face in faces for number in face})
    new = {number: index for index, number in enumerate(used, 1)}
    lines = [corners[number] for number in used]
    lines += ["f " + " ".join(str(new[number]) for number in face) for face in faces]
    return "\n".join(lines).encode()
