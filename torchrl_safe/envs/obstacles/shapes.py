"""Shapes of obstacles and of the objects that tasks move."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from torchrl_safe._checks import (
    check_kind,
    check_not_negative,
    check_positive,
    check_unit,
    keep_numbers,
)
from torchrl_safe.envs.rotations import UPRIGHT


@dataclass(frozen=True)
class Part:
    """A shape that is drawn with another one, and collides with nothing.

    Args:
        shape: the shape; its ``mass`` has no effect.
        position: its centre in the frame of the other one, m.
        orientation: a quaternion (x, y, z, w) in that frame.

    Raises:
        TypeError: if ``shape`` is not a shape.
        ValueError: if ``position`` or ``orientation`` has the wrong shape or is not finite, or
            ``orientation`` is no unit quaternion.

    Examples:
        >>> Part(Sphere(0.02), position=(0.0, 0.0, 0.1)).position
        (0.0, 0.0, 0.1)
    """

    shape: Shape
    position: tuple[float, float, float]
    orientation: tuple[float, float, float, float] = UPRIGHT

    def __post_init__(self) -> None:
        keep_numbers(self, "position", 3)
        check_unit("orientation", keep_numbers(self, "orientation", 4))
        check_kind("shape", self.shape, Shape)


@dataclass(frozen=True)
class Look:
    """How a shape is drawn. The physics does not depend on it.

    Args:
        colour: red, green and blue, from 0 to 1.
        parts: what is drawn with the shape, such as the body that belongs to a head.

    Raises:
        TypeError: if ``parts`` are not parts.
        ValueError: if ``colour`` is not three numbers from 0 to 1.

    Examples:
        >>> Sphere(0.1, look=Look(colour=(0.9, 0.7, 0.6))).look.colour
        (0.9, 0.7, 0.6)
    """

    colour: tuple[float, float, float]
    parts: tuple[Part, ...] = ()

    def __post_init__(self) -> None:
        colour = keep_numbers(self, "colour", 3)
        if not ((colour >= 0) & (colour <= 1)).all():
            raise ValueError(f"colour must be three numbers from 0 to 1, got {self.colour}.")
        check_kind("parts", self.parts, Sequence)
        for part in self.parts:
            check_kind("parts", part, Part)


@dataclass(frozen=True)
class Cylinder:
    """A cylinder along its z axis.

    Args:
        radius: its radius, m.
        height: its height, m.
        mass: kg; 0 fixes it in place, anything else can be pushed and knocked over.
        look: how it is drawn; by default in the colour of obstacles or of objects.

    Raises:
        TypeError: if ``look`` is not a Look.
        ValueError: if a size is not positive or the mass is negative.

    Examples:
        >>> Cylinder(radius=0.04, height=0.3).half_extents
        (0.04, 0.04, 0.15)
    """

    radius: float = 0.05
    height: float = 0.2
    mass: float = 0.0
    look: Look | None = field(default=None, repr=False, kw_only=True)

    def __post_init__(self) -> None:
        check_positive(radius=self.radius, height=self.height)
        _check_rest(self.mass, self.look)

    @property
    def half_extents(self) -> tuple[float, float, float]:
        """Half of the size along the shape's own x, y and z axes, m."""
        return (self.radius, self.radius, self.height / 2)


@dataclass(frozen=True)
class Box:
    """A cuboid.

    Args:
        half_extents: half of the size along its own x, y and z axes, m.
        mass: kg; 0 fixes it in place.
        look: how it is drawn; by default in the colour of obstacles or of objects.

    Raises:
        TypeError: if ``look`` is not a Look.
        ValueError: if a size is not positive or the mass is negative.

    Examples:
        >>> Box(half_extents=(0.02, 0.02, 0.02), mass=1.0).mass
        1.0
    """

    half_extents: tuple[float, float, float] = (0.05, 0.05, 0.1)
    mass: float = 0.0
    look: Look | None = field(default=None, repr=False, kw_only=True)

    def __post_init__(self) -> None:
        if not (keep_numbers(self, "half_extents", 3) > 0).all():
            raise ValueError(f"half_extents must be positive, got {self.half_extents}.")
        _check_rest(self.mass, self.look)


@dataclass(frozen=True)
class Sphere:
    """A ball.

    Args:
        radius: its radius, m.
        mass: kg; 0 fixes it in place.
        look: how it is drawn; by default in the colour of obstacles or of objects.

    Raises:
        TypeError: if ``look`` is not a Look.
        ValueError: if the radius is not positive or the mass is negative.

    Examples:
        >>> Sphere(0.1).half_extents
        (0.1, 0.1, 0.1)
    """

    radius: float = 0.08
    mass: float = 0.0
    look: Look | None = field(default=None, repr=False, kw_only=True)

    def __post_init__(self) -> None:
        check_positive(radius=self.radius)
        _check_rest(self.mass, self.look)

    @property
    def half_extents(self) -> tuple[float, float, float]:
        """Half of the size along the shape's own x, y and z axes, m."""
        return (self.radius,) * 3


@dataclass(frozen=True)
class Capsule:
    """A cylinder along its z axis with a half ball at each end.

    Args:
        radius: radius of the cylinder and of the half balls, m.
        length: distance between the centres of the half balls, m.
        mass: kg; 0 fixes it in place.
        look: how it is drawn; by default in the colour of obstacles or of objects.

    Raises:
        TypeError: if ``look`` is not a Look.
        ValueError: if a size is not positive or the mass is negative.

    Examples:
        >>> Capsule(radius=0.05, length=0.3).half_extents
        (0.05, 0.05, 0.2)
    """

    radius: float = 0.05
    length: float = 0.1
    mass: float = 0.0
    look: Look | None = field(default=None, repr=False, kw_only=True)

    def __post_init__(self) -> None:
        check_positive(radius=self.radius, length=self.length)
        _check_rest(self.mass, self.look)

    @property
    def half_extents(self) -> tuple[float, float, float]:
        """Half of the size along the shape's own x, y and z axes, m."""
        return (self.radius, self.radius, self.length / 2 + self.radius)


def _check_rest(mass: float, look: Look | None) -> None:
    check_not_negative(mass=mass)
    if look is not None:
        check_kind("look", look, Look)


#: What an obstacle or an object can look like.
Shape = Cylinder | Box | Sphere | Capsule


def footprint(shape: Shape) -> float:
    """Returns the radius of the circle around an upright shape seen from above, m.

    Examples:
        >>> footprint(Box((0.03, 0.04, 0.1)))
        0.05
    """
    match shape:
        case Box():
            return float(np.hypot(*shape.half_extents[:2]))
        case Cylinder() | Sphere() | Capsule():
            return shape.radius


def check_shapes(name: str, shapes: Sequence[Shape], *, movable: bool = False) -> None:
    """Raises TypeError unless these are shapes, ValueError unless they have a mass if movable."""
    check_kind(name, shapes, Sequence)
    for shape in shapes:
        check_kind(name, shape, Shape)
        if movable and not shape.mass:
            raise ValueError(f"{name} must have a mass to be moved, got {shape}.")
