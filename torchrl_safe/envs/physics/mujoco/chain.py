"""Forward kinematics of the arm for many poses at once.

MuJoCo computes where the tool is together with all contacts; here it takes a tenth of that.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from torchrl_safe.envs.physics.mujoco.engine import mujoco
from torchrl_safe.envs.physics.mujoco.quaternions import TO_MUJOCO, rotation_matrix
from torchrl_safe.envs.rotations import from_z_axis
from torchrl_safe.envs.state import Array


class ToolPose(NamedTuple):
    """The tool in k poses of the arm."""

    #: Tool points, m, ``(k, 3)``.
    position: Array
    #: Quaternions (x, y, z, w), ``(k, 4)``.
    orientation: Array
    #: Jacobians of the tool point, linear above angular, ``(k, 6, n)``.
    jacobian: Array


class Chain:
    """The joints from base to tool.

    Args:
        model: the ``MjModel`` of the world.
        joints: names of the arm's joints, from base to tool.
        tool: name of the body whose frame is the tool point.
    """

    def __init__(self, model: Any, joints: Sequence[str], tool: str) -> None:
        wanted = {model.joint(name).id for name in joints}
        path = [model.body(tool).id]
        while path[-1]:
            path.append(int(model.body_parentid[path[-1]]))
        # The frames of the joints are turned so that each turns about, or slides along, its z axis.
        before, frame, slides = [], np.eye(4), []
        for body in reversed(path[:-1]):
            frame = frame @ _frame(model.body_pos[body], model.body_quat[body])
            joint = model.body_jntadr[body]
            if joint in wanted:
                turned = _frame(np.zeros(3), from_z_axis(model.jnt_axis[joint])[TO_MUJOCO])
                before.append(frame @ turned)
                slides.append(model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_SLIDE)
                frame = turned.T
        self._end, self._slides = frame, np.array(slides)
        # At angle q a joint brings the frame before it to A + sin(q) B + (1 - cos(q)) C; one that
        # slides, to A + q D.
        self._fixed, turns = np.array(before), ~self._slides[:, None, None]
        cross, along = np.zeros((2, 4, 4))
        cross[0, 1], cross[1, 0], along[2, 3] = -1, 1, 1
        self._sine, self._cosine = self._fixed @ cross * turns, self._fixed @ cross @ cross * turns
        self._slide = self._fixed @ along * ~turns

    def __call__(self, angles: Array) -> ToolPose:
        """Returns where the tool is at joint angles, rad, ``(k, n)``."""
        angle = angles[:, :, None, None]
        steps = self._fixed + np.sin(angle) * self._sine + (1 - np.cos(angle)) * self._cosine
        if self._slides.any():
            steps += angle * self._slide
        frames = np.empty_like(steps)
        frames[:, 0] = steps[:, 0]
        for joint in range(1, steps.shape[1]):
            np.matmul(frames[:, joint - 1], steps[:, joint], out=frames[:, joint])
        tool = frames[:, -1] @ self._end
        # Along the first axis x, y, z: of the joints' axes, and of the ways from them to the tool.
        x, y, z = frames[:, :, :3, 2].transpose(2, 0, 1)
        to_x, to_y, to_z = tool[:, :3, 3].T[:, :, None] - frames[:, :, :3, 3].transpose(2, 0, 1)
        rows = [y * to_z - z * to_y, z * to_x - x * to_z, x * to_y - y * to_x, x, y, z]
        jacobian = np.stack(rows, axis=1)
        if self._slides.any():
            jacobian[:, :3, self._slides] = jacobian[:, 3:, self._slides]
            jacobian[:, 3:, self._slides] = 0
        return ToolPose(tool[:, :3, 3].copy(), quaternions(tool[:, :3, :3]), jacobian)


def quaternions(matrix: Array) -> Array:
    """Returns the quaternions (x, y, z, w) of rotation matrices, ``(k, 3, 3)``.

    Of the two of each, that with w or else the largest part positive, as PyBullet has it.
    """
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = np.ascontiguousarray(matrix.transpose(1, 2, 0))
    squares = np.array([xx - yy - zz, yy - xx - zz, zz - xx - yy, xx + yy + zz])
    largest = np.where(squares[3] > 0, 3, squares[:3].argmax(axis=0))
    # A symmetric matrix of all products of two parts, times 4.
    x2, y2, z2, w2 = squares + 1
    x_y, x_z, y_z = xy + yx, xz + zx, yz + zy
    x_w, y_w, z_w = zy - yz, xz - zx, yx - xy
    products = np.array(
        [x2, x_y, x_z, x_w, x_y, y2, y_z, y_w, x_z, y_z, z2, z_w, x_w, y_w, z_w, w2]
    ).reshape(4, 4, -1)
    chosen = products[largest, :, np.arange(len(matrix))]
    return chosen / np.linalg.norm(chosen, axis=1, keepdims=True)


def _frame(position: Array, quaternion: Array) -> Array:
    """A homogeneous matrix, of one of MuJoCo's quaternions."""
    frame = np.eye(4)
    frame[:3, :3], frame[:3, 3] = rotation_matrix(quaternion), position
    return frame
