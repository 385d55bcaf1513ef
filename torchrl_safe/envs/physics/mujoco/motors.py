"""Motors that do within a control step what an action asks for."""

from __future__ import annotations

from typing import Any

import numpy as np

from torchrl_safe.envs.physics.mujoco.arm import ArmParts
from torchrl_safe.envs.physics.mujoco.engine import mujoco
from torchrl_safe.envs.physics.scene import SUBSTEP
from torchrl_safe.envs.state import Array

# How fast the motors of the joints correct, rad/s. Their damping then stops a joint within one
# substep. With a higher value, motors at the limit of their efforts would chatter, since MuJoCo
# does not integrate that limit implicitly.
_RATE = 0.5 / SUBSTEP
# What the rotors of geared motors add to the inertia of a joint at home. Without it, joints with
# nearly the same axis, such as the first and third of a stretched arm, have almost no inertia
# against each other, and swing as soon as both are at the limit of their efforts.
_ROTORS = 0.5
# Light joints, such as a wrist's, get at least the inertia that full effort brings to full speed in
# this time, s. Gains are in proportion to it. With less, a small error would throw the joint about,
# or the joints before it would.
_RUN_UP = 4 * SUBSTEP
# Fingers press with all their effort if they are kept this far from their target, m.
_SQUEEZE = 0.005
# The effort of fingers that have no limit, N.
_FINGER_EFFORT = 20.0
#: The group of the fingers' motors, which rest where an action moves no fingers.
FINGER_GROUP = 1


def add_motors(spec: Any, parts: ArmParts, *, limited: bool, strength: float) -> None:
    """Adds a position and a velocity servo to each joint: first all positions, then velocities.

    Args:
        spec: the world; changed in place.
        parts: of the arm.
        limited: keep the two of a joint together within its effort.
        strength: share of the effort that they have.
    """
    names = parts.joints + parts.fingers
    for kind in ("position", "velocity"):
        for name in names:
            motor = spec.add_actuator(
                name=f"{name}/{kind}", target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT
            )
            motor.group = FINGER_GROUP if name in parts.fingers else 0
            # The gains follow when the masses are known.
            if kind == "position":
                motor.set_to_position(kp=1.0, kv=0.0)
            else:
                motor.set_to_velocity(kv=1.0)
    for name, effort in zip(names, (strength * parts.effort).tolist(), strict=True):
        if limited and np.isfinite(effort):
            joint = spec.joint(name)
            joint.actfrclimited, joint.actfrcrange = True, (-effort, effort)


def add_rotors(spec: Any, parts: ArmParts, mass: Array) -> Array:
    """Adds what turns with the motors.

    Args:
        spec: the world; changed in place.
        parts: of the arm.
        mass: the diagonal of the mass matrix for joints and fingers at home, kg m^2 and kg.

    Returns:
        The diagonal with what was added.
    """
    with np.errstate(invalid="ignore"):  # Infinite both.
        run_up = np.divide(parts.effort, parts.speed) * _RUN_UP
    rotors = np.maximum(_ROTORS * mass, np.where(np.isfinite(run_up), run_up, 0) - mass)
    efforts = parts.effort[len(parts.joints) :]
    # Fingers are as heavy as makes them as stiff as that.
    strength = np.where(np.isfinite(efforts), efforts, _FINGER_EFFORT) / _SQUEEZE
    rotors[len(parts.joints) :] = strength / _RATE**2
    for name, rotor in zip(parts.joints + parts.fingers, rotors.tolist(), strict=True):
        spec.joint(name).armature = rotor
    return mass + rotors


def set_gains(model: Any, parts: ArmParts, mass: Array, *, limited: bool) -> None:
    """Makes the servos of each joint critically damped for what it has to move at home.

    The velocity servo brakes, and the position servo, whose target leads, drives. The bound on the
    force of the position servo also bounds the speed: a joint goes no faster than where both are in
    balance, however far it is behind its target.

    Args:
        model: the compiled world; changed in place.
        parts: of the arm.
        mass: the diagonal of the mass matrix for joints and fingers, kg m^2 and kg.
        limited: keep joints within their speeds.
    """
    count, stiffness, damping = len(mass), mass * _RATE**2, 2 * mass * _RATE
    position, velocity = slice(0, count), slice(count, 2 * count)
    model.actuator_gainprm[position, 0] = stiffness
    model.actuator_biasprm[position, 1] = -stiffness
    model.actuator_gainprm[velocity, 0] = damping
    model.actuator_biasprm[velocity, 2] = -damping
    # Fingers that are kept from moving need less than their speed's worth to press in full.
    efforts = np.where(np.isfinite(parts.effort), parts.effort, _FINGER_EFFORT)
    strongest = np.maximum(damping * parts.speed, efforts)
    bounded = limited & np.isfinite(strongest)
    model.actuator_forcelimited[position] = bounded
    model.actuator_forcerange[position] = np.where(bounded, strongest, 0)[:, None] * (-1, 1)


def fill_controls(controls: Array, current: Array, targets: Array) -> None:
    """Writes the controls of a control step: targets that move evenly over the substeps.

    With 12 substeps the joints do what is asked for to within one percent, if efforts allow. They
    lag by two substeps: in a control step of six substeps they do 0.96 of it, in one of a single
    substep about 0.6, and the rest in the next.

    Args:
        controls: what is written, ``(N, s, 2 k)``: the first half; the other stays 0.
        current: where joints and fingers are, ``(N, k)``.
        targets: where they are to be after the last substep, ``(N, k)``.
    """
    substeps, count = controls.shape[1], current.shape[1]
    change = targets - current
    # Ahead by as much as makes good for the braking at the speed of the target.
    lead = 2 / (_RATE * substeps * SUBSTEP)
    # Shares of what each substep adds, and of what it begins from.
    shares = np.ones((substeps, 2))
    shares[:, 0] = np.arange(1, substeps + 1) / substeps + lead
    parts = np.zeros((len(current), 2, 2 * count))
    parts[:, 0, :count], parts[:, 1, :count] = change, current
    np.matmul(shares, parts, out=controls)
