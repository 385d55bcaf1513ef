"""The record that tasks, costs, actions and observations read."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ArmState:
    """State of N worlds after a control step, in SI units and world coordinates.

    n is the number of arm joints, f of free finger joints, m of obstacles.

    Attributes:
        joint_position: joint angles, rad, ``(N, n)``.
        joint_velocity: joint velocities, rad/s, ``(N, n)``.
        joint_lower: lower joint limits, rad, ``(n,)``.
        joint_upper: upper joint limits, rad, ``(n,)``.
        finger_position: free finger joints, m, ``(N, f)``.
        ee_position: tool point, m, ``(N, 3)``.
        ee_orientation: tool orientation as a quaternion (x, y, z, w), ``(N, 4)``.
        ee_velocity: velocity of the tool point, m/s, ``(N, 3)``.
        goal: target position, m, ``(N, 3)``.
        obstacle_position: centres of the obstacles, m, ``(N, m, 3)``.
        obstacle_velocity: velocities of the obstacles, m/s, ``(N, m, 3)``.
        obstacle_size: half extents of the obstacles along x, y, z, m, ``(m, 3)``.
        contact_distance: smallest distance between arm and obstacle among the contact points
            of **all** physics substeps of the last control step, m, ``(N, m)``. Negative where
            they overlap, infinite where the simulator reports no contact.
    """

    joint_position: Array
    joint_velocity: Array
    joint_lower: Array
    joint_upper: Array
    finger_position: Array
    ee_position: Array
    ee_orientation: Array
    ee_velocity: Array
    goal: Array
    obstacle_position: Array
    obstacle_velocity: Array
    obstacle_size: Array
    contact_distance: Array
