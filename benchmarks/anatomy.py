"""What a control step in MuJoCo spends its time on."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import wraps
from time import process_time
from typing import Any
from unittest import mock

from benchmarks.rollouts import Canned, play
from torchrl_safe.envs import ArmEnv


class Clock:
    """Adds up the processor time inside functions."""

    def __init__(self) -> None:
        self.seconds = 0.0

    def watch(self, function: Callable[..., Any]) -> Callable[..., Any]:
        """Returns the function, timed."""

        @wraps(function)
        def watched(*args: Any, **options: Any) -> Any:
            start = process_time()
            try:
                return function(*args, **options)
            finally:
                self.seconds += process_time() - start

        return watched


@contextmanager
def watching(env: ArmEnv) -> Iterator[dict[str, Clock]]:
    """Watches the parts of an environment's steps."""
    simulator: Any = env._simulator
    parts: list[tuple[str, Any, tuple[str, ...]]] = [
        ("physics", simulator._batch, ("rollout",)),
        ("advance", simulator, ("advance",)),
        ("state: kinematics, bodies", simulator, ("state",)),
        ("joint targets", type(env.action_mode), ("targets",)),
        ("check of actions, speeds", env, ("_check_action", "_within_speed")),
        ("reward, costs, success", env, ("_outcome",)),
        ("observation", env, ("_observe",)),
        ("TensorDict", env, ("_pack",)),
    ]
    clocks = {}
    with ExitStack() as stack:
        for name, owner, functions in parts:
            clocks[name] = Clock()
            for function in functions:
                watched = clocks[name].watch(getattr(owner, function))
                stack.enter_context(mock.patch.object(owner, function, watched))
        yield clocks


def anatomy(env: ArmEnv, steps: int) -> dict[str, float]:
    """Returns the seconds of each part of a step, physics first, in the mean of a rollout."""
    policy = Canned(env, steps)
    env.set_seed(0)
    start = env.reset()
    with watching(env) as clocks:
        begin = process_time()
        play(env, policy, steps, start)
        total = process_time() - begin
    seconds = {name: clock.seconds / steps for name, clock in clocks.items()}
    seconds["controls, contacts"] = seconds.pop("advance") - seconds["physics"]
    seconds["TorchRL's own, and the rest"] = total / steps - sum(seconds.values())
    return seconds
