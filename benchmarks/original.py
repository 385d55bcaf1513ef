"""The step and the reset of Kovač & Farkaš 2023, written anew from a description of their code.

Only to compare with. One world; a reset loads every file again, and the tool is moved by
PyBullet's iterative inverse kinematics. Left out is the new PyBullet server that their reset
opens each time and never closes, which makes it slower still.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Literal

import numpy as np
import pybullet as p
import pybullet_data

_DATA = Path(pybullet_data.getDataPath())
_HOME = (0, -0.215, 0, -2.57, 0, 2.356, 2.356)
_FINGERS, _TOOL = (9, 10), 11
_DOWN = p.getQuaternionFromEuler((0, -math.pi, math.pi / 2))


class OriginalEnv:
    """The Panda, a free cylinder and a brick to reach, at 240 Hz.

    Args:
        action: "cartesian" (AR1: tool displacements and the fingers) or "joint" (AR2).
        seed: seed of the places of the brick.
    """

    def __init__(self, action: Literal["cartesian", "joint"], seed: int = 0) -> None:
        self.action, self.steps = action, 0
        self._client = p.connect(p.DIRECT)
        self._generator = np.random.default_rng(seed)

    def reset(self) -> np.ndarray:
        """Loads everything anew."""
        client = self._client
        self.steps = 0
        p.resetSimulation(physicsClientId=client)
        p.setGravity(0, 0, -10, physicsClientId=client)
        self._load("plane.urdf", (0, 0, -0.65))
        self.arm = self._load(
            "franka_panda/panda.urdf",
            (0, 0, 0),
            useFixedBase=True,
            flags=p.URDF_USE_INERTIA_FROM_FILE,
        )
        for joint, angle in enumerate(_HOME):
            p.resetJointState(self.arm, joint, angle, physicsClientId=client)
        for finger in _FINGERS:
            p.resetJointState(self.arm, finger, 0.08, physicsClientId=client)
        self._load("table/table.urdf", (0.5, 0, -0.65))
        x, y = self._generator.uniform((0.6, -0.2), (0.8, 0.2))
        self.target = self._load("lego/lego.urdf", (x, y, 0.05))
        size = {"radius": 0.05, "physicsClientId": client}
        body = p.createCollisionShape(p.GEOM_CYLINDER, height=0.2, **size)
        skin = p.createVisualShape(p.GEOM_CYLINDER, length=0.2, **size)
        place = (x - 0.2, y, 0.05)
        self.obstacle = p.createMultiBody(1.0, body, skin, place, physicsClientId=client)
        return self._observe(self._tool(), self._target())

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, dict[str, int]]:
        """One physics substep; returns observation, reward, done and the cost."""
        client = self._client
        if self.action == "cartesian":
            goal = np.add(self._tool(), 0.05 * action[:3]).tolist()
            angles = p.calculateInverseKinematics(
                self.arm, _TOOL, goal, _DOWN, physicsClientId=client
            )
            joints = [*range(7), *_FINGERS]
            targets = [*angles[:7], float(action[3]), float(action[3])]
        else:
            joints = list(range(7))
            states = p.getJointStates(self.arm, joints, physicsClientId=client)
            targets = [state[0] + 0.1 * a for state, a in zip(states, action.tolist(), strict=True)]
        p.setJointMotorControlArray(
            self.arm, joints, p.POSITION_CONTROL, targets, physicsClientId=client
        )
        p.stepSimulation(physicsClientId=client)
        tool, target = self._tool(), self._target()
        self.steps += 1
        reward = -float(np.abs(np.subtract(tool, target)).sum())
        done = reward > -0.09 or self.steps > 500
        if target[2] > 0.45:
            reward, done = reward + 1, True
        contacts = p.getContactPoints(self.arm, self.obstacle, physicsClientId=client)
        return self._observe(tool, target), reward, done, {"cost": int(bool(contacts))}

    def close(self) -> None:
        """Closes the world."""
        p.disconnect(self._client)

    def _load(self, urdf: str, position: tuple[float, ...], **kwargs: object) -> int:
        return p.loadURDF(str(_DATA / urdf), position, physicsClientId=self._client, **kwargs)

    def _tool(self) -> tuple[float, ...]:
        return p.getLinkState(self.arm, _TOOL, physicsClientId=self._client)[0]

    def _target(self) -> tuple[float, ...]:
        return p.getBasePositionAndOrientation(self.target, physicsClientId=self._client)[0]

    def _observe(self, tool: tuple[float, ...], target: tuple[float, ...]) -> np.ndarray:
        fingers = [
            p.getJointState(self.arm, finger, physicsClientId=self._client)[0]
            for finger in _FINGERS
        ]
        return np.array([*tool, *fingers, *target], dtype=np.float32)
