"""The physics floor: the steps of PyBullet that an environment has taken, and nothing else."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from time import process_time
from typing import Any
from unittest import mock

import pybullet

Call = Callable[[], Any]


class Tape:
    """Records an environment's motor commands and physics steps, and plays them again.

    Played from the state that the environment was in, the worlds move as they have moved: the
    floor is that of an arm in motion. The commands are sent in between, but not timed.
    """

    def __init__(self) -> None:
        # Commands as calls, each before the client numbers of the steps that follow it.
        self._tape: list[tuple[Call, list[int]]] = []

    @contextmanager
    def recording(self) -> Iterator[None]:
        """Records what is sent to PyBullet's motors, and each physics step."""
        command, step = pybullet.setJointMotorControlArray, pybullet.stepSimulation

        def record_command(*args: Any, **kwargs: Any) -> None:
            self._tape.append((partial(command, *args, **kwargs), []))
            command(*args, **kwargs)

        def record_step(physicsClientId: int) -> None:  # noqa: N803
            self._tape[-1][1].append(physicsClientId)
            step(physicsClientId=physicsClientId)

        with (
            mock.patch.object(pybullet, "setJointMotorControlArray", record_command),
            mock.patch.object(pybullet, "stepSimulation", record_step),
        ):
            yield

    def play(self) -> float:
        """Sends all again and returns the seconds of the physics steps alone."""
        step, seconds = pybullet.stepSimulation, 0.0
        for send, clients in self._tape:
            send()
            start = process_time()
            for client in clients:
                step(physicsClientId=client)
            seconds += process_time() - start
        return seconds
