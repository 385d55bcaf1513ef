"""Obstacles: their shapes, where they stand and how they move."""

from torchrl_safe.envs.obstacles.human import Human
from torchrl_safe.envs.obstacles.layouts import (
    InFront,
    NoObstacles,
    Obstacles,
    Path,
    Placement,
    Scattered,
)
from torchrl_safe.envs.obstacles.moving import Motion, Moving, Patrol, Swing
from torchrl_safe.envs.obstacles.shapes import Box, Capsule, Cylinder, Look, Part, Shape, Sphere

__all__ = [
    "Box",
    "Capsule",
    "Cylinder",
    "Human",
    "InFront",
    "Look",
    "Motion",
    "Moving",
    "NoObstacles",
    "Obstacles",
    "Part",
    "Path",
    "Patrol",
    "Placement",
    "Scattered",
    "Shape",
    "Sphere",
    "Swing",
]
