"""A human whose arm reaches into the workspace."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from torchrl_safe._checks import check_positive, keep_numbers
from torchrl_safe.envs.obstacles.layouts import Placement
from torchrl_safe.envs.obstacles.shapes import Capsule, Look, Part, Shape, Sphere
from torchrl_safe.envs.rotations import from_z_axis
from torchrl_safe.envs.state import Array

# Reaches before the motion repeats itself. An episode of the usual length has fewer.
_REACHES = 16
_SPREAD = 0.08
# Lengths in m; the hand is the far end of the forearm, the head is given from the shoulder.
_UPPER_ARM, _FOREARM, _HEAD = 0.28, 0.35, (0.05, -0.2, 0.25)
# Colours of what is drawn.
_SKIN, _HAIR, _EYE = (0.90, 0.69, 0.55), (0.27, 0.17, 0.10), (0.05, 0.05, 0.05)
_SHIRT, _TROUSERS = (0.53, 0.33, 0.66), (0.25, 0.27, 0.38)
# Between these distances from hand to shoulder the elbow is neither straight nor folded flat.
_NEAREST, _REACH = 0.12, 0.62


@dataclass(frozen=True)
class Human:
    """A person opposite the arm: capsules for upper arm and forearm with the hand, and a head.

    Pictures also show the rest of the body, which cannot be touched.

    The hand waits beside the shoulder, reaches for a point on the way from start to goal, rests
    there for a while, goes back and begins again with another point. It moves along straight
    lines with the minimum-jerk profile of human reaching (Flash & Hogan 1985, J. Neurosci. 5(7));
    the elbow hangs down and away from the robot. Lengths are those of an average adult (upper arm
    0.28 m, forearm and fist 0.35 m; Winter 2009, Biomechanics and Motor Control of Human
    Movement).

    The person does not yield to the arm.

    Args:
        shoulder: position of the shoulder, m.
        rest: position of the hand between two reaches, m.
        duration: shortest and longest time of a reach, s; the way back has such a time of its
            own. The largest speed of the hand is 1.875 times distance over duration.
        pause: shortest and longest wait before and after a reach, s.

    Raises:
        ValueError: if an argument has the wrong shape, a time is not positive, or ``rest`` is
            further from the shoulder than the arm is long, or nearer than it can bend.

    Examples:
        >>> placement = Human().sample(np.random.default_rng(0), np.zeros(3), np.ones(3))
        >>> [type(shape).__name__ for shape in Human().shapes], placement.position.shape
        (['Capsule', 'Capsule', 'Sphere'], (3, 3))
    """

    shoulder: tuple[float, float, float] = (1.1, 0.2, 0.4)
    rest: tuple[float, float, float] = (0.9, 0.25, 0.2)
    duration: tuple[float, float] = (0.7, 1.4)
    pause: tuple[float, float] = (0.1, 0.8)

    def __post_init__(self) -> None:
        shoulder = keep_numbers(self, "shoulder", 3)
        rest = keep_numbers(self, "rest", 3)
        for name in ("duration", "pause"):
            shortest, longest = keep_numbers(self, name, 2)
            check_positive(**{name: float(shortest)})
            if shortest > longest:
                raise ValueError(f"{name} must be shortest, longest, got {shortest}, {longest}.")
        length = np.linalg.norm(rest - shoulder)
        if not _NEAREST <= length <= _REACH:
            raise ValueError(
                f"rest must be {_NEAREST} to {_REACH} m from the shoulder, got {self.rest}, which "
                f"is {length:.3f} m away."
            )

    @property
    def shapes(self) -> tuple[Shape, ...]:
        hand = Part(Sphere(0.047, look=Look(_SKIN)), (0.0, 0.0, _FOREARM / 2))
        return (
            Capsule(radius=0.05, length=_UPPER_ARM, look=Look(_SHIRT)),
            Capsule(radius=0.045, length=_FOREARM, look=Look(_SHIRT, parts=(hand,))),
            Sphere(radius=0.1, look=Look(_SKIN, parts=_BODY)),
        )

    def sample(self, rng: np.random.Generator, start: Array, goal: Array) -> Placement:
        along = rng.uniform(0.2, 1.0, (_REACHES, 1))
        targets = start + along * (goal - start) + rng.uniform(-_SPREAD, _SPREAD, (_REACHES, 3))
        # The centre of the hand stays above the table.
        targets[:, 2] = np.maximum(targets[:, 2], 0.08)
        # The hand goes towards a point that is too far away, as far as the arm is long.
        shoulder = np.array(self.shoulder)
        distance = np.linalg.norm(targets - shoulder, axis=1, keepdims=True)
        targets = shoulder + np.minimum(1, _REACH / distance) * (targets - shoulder)
        # A reach is four stretches of time: wait, go there, stay there, come back.
        waits = rng.uniform(*self.pause, (_REACHES, 2))
        moves = rng.uniform(*self.duration, (_REACHES, 2))
        spans = np.stack([waits[:, 0], moves[:, 0], waits[:, 1], moves[:, 1]], axis=1).ravel()
        rest = np.tile(self.rest, (_REACHES, 1))
        stops = np.stack([rest, rest, targets, targets], axis=1).reshape(-1, 3)
        begins = np.cumsum(spans) - spans

        def path(times: Array) -> tuple[Array, Array]:
            times = times % spans.sum()
            index = np.searchsorted(begins, times, side="right") - 1
            here, there = stops[index], stops[(index + 1) % len(stops)]
            share = ((times - begins[index]) / spans[index])[:, None]
            return self._pose(here + _minimum_jerk(share) * (there - here))

        position, orientation = path(np.zeros(1))
        return Placement(position[0], orientation[0], path=path)

    def _pose(self, hand: Array) -> tuple[Array, Array]:
        """Centres and orientations of the capsules for positions of the hand, ``(s, 3)``."""
        shoulder = np.array(self.shoulder)
        way = hand - shoulder
        length = np.linalg.norm(way, axis=1, keepdims=True)
        way = way / np.maximum(length, 1e-9)
        length = np.clip(length, _NEAREST, _REACH)
        hand = shoulder + length * way
        # The elbow, by the law of cosines. It hangs down, and away from the robot where the hand
        # is below the shoulder.
        cosine = (_UPPER_ARM**2 + length**2 - _FOREARM**2) / (2 * _UPPER_ARM * length)
        aside = np.array([*_unit(shoulder[:2]), -1.0])
        down = aside - (way @ aside)[:, None] * way
        down /= np.maximum(np.linalg.norm(down, axis=1, keepdims=True), 1e-9)
        elbow = shoulder + _UPPER_ARM * (cosine * way + np.sqrt(1 - cosine**2) * down)
        head = np.broadcast_to(shoulder + _HEAD, hand.shape)
        positions = np.stack([(shoulder + elbow) / 2, (elbow + hand) / 2, head], axis=1)
        axes = np.stack(
            [
                # Upwards: from_z_axis is singular at -z, where a hanging upper arm points.
                (shoulder - elbow) / _UPPER_ARM,
                (hand - elbow) / _FOREARM,
                np.broadcast_to((0.0, 0.0, 1.0), hand.shape),
            ],
            axis=1,
        )
        return positions, from_z_axis(axes)


def _unit(vector: Array) -> Array:
    return vector / np.maximum(np.linalg.norm(vector), 1e-9)


def _minimum_jerk(share: Array) -> Array:
    """Share of the way after a share of the time (Flash & Hogan 1985, eq. 3 for rest to rest)."""
    return share**3 * (10 - 15 * share + 6 * share**2)


def _limb(
    start: tuple[float, float, float],
    end: tuple[float, float, float],
    radius: float,
    colour: tuple[float, float, float],
) -> Part:
    way = np.subtract(end, start)
    x, y, z, w = from_z_axis(_unit(way)).tolist()
    middle = np.add(start, way / 2).tolist()
    shape = Capsule(radius, float(np.linalg.norm(way)), look=Look(colour))
    return Part(shape, (middle[0], middle[1], middle[2]), (x, y, z, w))


def _ball(position: tuple[float, float, float], radius: float, colour: Any) -> Part:
    return Part(Sphere(radius, look=Look(colour)), position)


def _body() -> tuple[Part, ...]:
    """The rest of a person who leans over the table towards the robot, from the head's centre."""
    right, left = (-0.05, 0.2, -0.25), (-0.05, -0.2, -0.25)
    elbow, hand = (0.06, -0.27, -0.48), (-0.05, -0.24, -0.6)
    return (
        _ball((0.018, 0.0, 0.022), 0.102, _HAIR),
        _ball((-0.09, 0.035, 0.015), 0.014, _EYE),
        _ball((-0.09, -0.035, 0.015), 0.014, _EYE),
        _ball((-0.1, 0.0, -0.02), 0.018, _SKIN),
        _limb((0.01, 0.0, -0.08), (-0.03, 0.0, -0.24), 0.045, _SKIN),
        _limb(right, left, 0.06, _SHIRT),
        *(_limb((-0.02, y, -0.3), (0.25, 0.8 * y, -0.66), 0.1, _SHIRT) for y in (-0.08, 0.08)),
        *(_limb((0.26, y, -0.72), (0.3, y, -1.3), 0.075, _TROUSERS) for y in (-0.09, 0.09)),
        _limb(left, elbow, 0.05, _SHIRT),
        _limb(elbow, hand, 0.045, _SHIRT),
        _ball(hand, 0.047, _SKIN),
    )


_BODY = _body()
