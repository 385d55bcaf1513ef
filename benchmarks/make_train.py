"""The main job as a person runs it, with each engine: ``make train``, wall clock."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from pathlib import Path
from time import perf_counter

from benchmarks.report import Figure
from benchmarks.timing import Contender, quartiles, race, ratio

_QUICK = (
    "--algorithms ppo --frames 64 --frames-per-batch 64 --envs 4 --workers 1 --minibatch 32 "
    "--eval-episodes 2"
)


def program(physics: str, options: str) -> Contender:
    """The whole program: imports, both algorithms, their evaluations, table and pictures."""

    def run() -> float:
        with tempfile.TemporaryDirectory() as folder:
            # The benchmarks have one thread; `make train` has what the machine has.
            environment = {k: v for k, v in os.environ.items() if k != "OMP_NUM_THREADS"}
            command = [sys.executable, "-m", "experiments.train", "--physics", physics]
            command += ["--out", str(Path(folder, "run")), *options.split()]
            start = perf_counter()
            subprocess.run(command, check=True, capture_output=True, env=environment)
            return perf_counter() - start

    return run


def run(*, quick: bool) -> list[Figure]:
    """Measures it once: at seven minutes, the noise of a machine is small against the ratio."""
    options = _QUICK if quick else ""
    contenders = {engine: program(engine, options) for engine in ("bullet", "mujoco")}
    times = race(contenders, rounds=1, warm_up=False)
    return [
        ratio("make train, MuJoCo / Bullet", times["bullet"], times["mujoco"], at_least=2),
        *(quartiles(f"make train, {name}", seconds, "s") for name, seconds in times.items()),
    ]
