"""Runs many independent jobs side by side, each once: a stopped grid goes on where it was."""

from __future__ import annotations

import json
import multiprocessing
from collections.abc import Callable, Mapping
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path
from typing import Any

from tqdm import tqdm

from experiments.files import write_whole


def missing(jobs: Mapping[Path, Any]) -> list[Path]:
    """The files of jobs that have not been run."""
    return [path for path in jobs if not path.exists()]


def run_grid(
    run: Callable[..., dict[str, Any]],
    jobs: Mapping[Path, tuple[Any, ...]],
    *,
    workers: int,
    name: str,
) -> list[dict[str, Any]]:
    """Runs what is missing and returns what all jobs returned, in their order.

    Args:
        run: called as ``run(*arguments)`` in a process of its own; what it returns is kept as
            JSON.
        jobs: the arguments of each job by the file its result is kept in.
        workers: processes side by side.
        name: what the progress bar is called.
    """
    for path in jobs:
        path.parent.mkdir(parents=True, exist_ok=True)
    todo = missing(jobs)
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers, context) as pool:
        running = [pool.submit(_run_and_keep, run, path, jobs[path]) for path in todo]
        for done in tqdm(as_completed(running), total=len(todo), desc=name, unit="run"):
            if done.exception() is not None:
                pool.shutdown(cancel_futures=True)
                done.result()
    return [json.loads(path.read_text()) for path in jobs]


def _run_and_keep(run: Callable[..., dict[str, Any]], path: Path, arguments: Any) -> None:
    write_whole(path, json.dumps(run(*arguments)))
