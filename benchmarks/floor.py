"""The physics floor: the steps of PyBullet that an environment has taken, and nothing else."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from time import process_time
from typing import Any
from unittest import mock

import pybullet

Call = Callable[[], Any]


class Tape:
    """Records an environment's motor commands and physics steps, and plays them again.

    Played from the state that the environment was in, the worlds move as they have moved: the
    floor is that of an arm in motion.

    Args:
        num_envs: number of worlds.
    """

    def __init__(self, num_envs: int) -> None:
        self._num_envs = num_envs
        self._commands: list[tuple[Call, tuple[Any, ...], dict[str, Any]]] = []
        self._clients: list[int] = []

    @contextmanager
    def recording(self) -> Iterator[None]:
        """Records what is sent to PyBullet's motors, and each physics step."""
        command, step = pybullet.setJointMotorControlArray, pybullet.stepSimulation

        def record_command(*args: Any, **kwargs: Any) -> None:
            self._commands.append((command, args, kwargs))
            command(*args, **kwargs)

        def record_step(physicsClientId: int) -> None:  # noqa: N803
            self._clients.append(physicsClientId)
            step(physicsClientId=physicsClientId)

        with (
            mock.patch.object(pybullet, "setJointMotorControlArray", record_command),
            mock.patch.object(pybullet, "stepSimulation", record_step),
        ):
            yield

    def play(self) -> float:
        """Sends all again and returns the seconds of the physics steps alone."""
        control_steps = len(self._commands) // self._num_envs
        commands, steps = self._num_envs, len(self._clients) // control_steps
        step, seconds = pybullet.stepSimulation, 0.0
        for index in range(control_steps):
            for send, args, kwargs in self._commands[commands * index : commands * (index + 1)]:
                send(*args, **kwargs)
            clients = self._clients[steps * index : steps * (index + 1)]
            start = process_time()
            for client in clients:
                step(physicsClientId=client)
            seconds += process_time() - start
        return seconds
