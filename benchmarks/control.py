"""A policy from a file in a control loop at 20 Hz: are all deadlines met, from the first on?"""

from __future__ import annotations

import re
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from time import perf_counter, sleep
from typing import NamedTuple

import numpy as np
import torch

from benchmarks.report import Figure
from benchmarks.timing import quartiles
from torchrl_safe.envs import PANDA, ArmEnv
from torchrl_safe.policy import Policy, load_policy

QUICKSTART = Path(__file__).parent.parent / "docs" / "start" / "quickstart.md"


class Drive(NamedTuple):
    """Times of a drive, in seconds, ``(steps,)``.

    Args:
        calls: what each call of the policy took.
        late: how long after its deadline each step was done; negative if before.
    """

    calls: np.ndarray
    late: np.ndarray


@contextmanager
def policy_of_the_readme() -> Iterator[Path]:
    """Trains with the quickstart's own loop, for one batch, in another process; yields its file."""
    loop = re.findall(r"```python\n(.*?)```", QUICKSTART.read_text(encoding="utf-8"), re.S)[1]
    with tempfile.TemporaryDirectory() as folder:
        short, changes = re.subn(r"total_frames=[\d_]+", "total_frames=2_048", loop)
        assert changes == 1
        command = [sys.executable, "-c", short]
        subprocess.run(command, cwd=folder, check=True, stdout=subprocess.DEVNULL)
        yield Path(folder, "policy.pt")


def drive(env: ArmEnv, policy: Policy, *, steps: int, period: float) -> Drive:
    """Drives one arm in real time; the simulator's step counts as the robot's."""
    calls, late = np.zeros(steps), np.zeros(steps)
    tensordict = env.reset()
    start = perf_counter()
    for step in range(steps):
        observation = tensordict["observation"][0].numpy()
        before = perf_counter()
        action = policy(observation)
        calls[step] = perf_counter() - before
        tensordict["action"] = torch.from_numpy(action)[None]
        _, tensordict = env.step_and_maybe_reset(tensordict)
        deadline = start + (step + 1) * period
        late[step] = perf_counter() - deadline
        sleep(max(0.0, -late[step]))
    return Drive(calls, late)


def run(*, quick: bool) -> list[Figure]:
    """Measures all of it. The machine must have nothing else to do."""
    steps = 5 if quick else 400
    with policy_of_the_readme() as file, closing(ArmEnv(PANDA, seed=0)) as env:
        # The robot runs before its controller starts.
        env.rollout(2)
        policy = load_policy(file)
        calls, late = drive(env, policy, steps=steps, period=1 / env.control_rate)
    missed = float((late > 0).sum())
    first, slowest = 1e3 * calls[0], 1e3 * calls[1:].max()
    rate = f"{env.control_rate:g} Hz"
    return [
        Figure(
            f"missed deadlines in {steps} steps at {rate}", missed, missed, missed, "", at_most=0
        ),
        Figure("first call of the policy", first, first, first, "ms"),
        quartiles("later calls", 1e3 * calls[1:], "ms"),
        Figure("slowest later call", slowest, slowest, slowest, "ms"),
    ]
