"""Runs many independent jobs side by side, each once: a stopped grid goes on where it was."""

from __future__ import annotations

import dataclasses
import json
import multiprocessing
import os
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from itertools import islice
from pathlib import Path
from typing import Any

from tqdm import tqdm

from experiments.files import write_whole
from experiments.log import versions
from experiments.options import check_once
from torchrl_safe._checks import check_count
from torchrl_safe.checkpoint import refuse_other_settings


def check_grid(config: Any, *names: str) -> None:
    """Checks the settings of a grid: ``jobs``, and what it goes through, each thing once."""
    for name in names:
        check_once(name, getattr(config, name))
    check_count(jobs=config.jobs)


def missing(jobs: Mapping[Path, Any]) -> list[Path]:
    """The files of jobs that have not been run."""
    return [path for path in jobs if not path.exists()]


def side_by_side(
    run: Callable[..., Any], arguments: Sequence[tuple[Any, ...]], *, workers: int
) -> Iterator[tuple[int, Any]]:
    """Calls ``run`` in processes that end with this one, whatever ends it.

    Args:
        run: called as ``run(*arguments[index])``.
        arguments: the arguments of each call.
        workers: processes side by side.

    Yields:
        Index and result of each call, in the order in which they end. After a call that fails no
        other begins.
    """
    context = multiprocessing.get_context("spawn")
    others = set(multiprocessing.active_children())
    lock = context.RLock()
    with ProcessPoolExecutor(workers, context, initializer=_prepare, initargs=(lock,)) as pool:
        try:
            calls = iter(enumerate(arguments))
            running: dict[Future[Any], int] = {}

            def begin(count: int) -> None:
                running.update((pool.submit(run, *each), n) for n, each in islice(calls, count))

            begin(workers)  # The pool itself would begin one more than it has workers.
            while running:
                ended, _ = wait(running, return_when=FIRST_COMPLETED)
                for call in ended:
                    yield running.pop(call), call.result()
                begin(len(ended))
        except Exception:
            pool.shutdown(cancel_futures=True)
            raise
        except BaseException:  # Ctrl+C, which may have come to this process alone.
            pool.shutdown(wait=False, cancel_futures=True)
            for process in set(multiprocessing.active_children()) - others:
                process.terminate()
            raise


def _prepare(lock: Any) -> None:
    """Lets progress bars take turns, and ends this process with its parent."""
    tqdm.set_lock(lock)
    parent = multiprocessing.parent_process()
    assert parent is not None

    def watch() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


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

    Raises:
        ValueError: if there is a result of a run with other arguments.
    """
    for path in jobs:
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.exists():
            _check_same(path, jobs[path])
    todo = [(run, path, jobs[path]) for path in missing(jobs)]
    done = side_by_side(_run_and_keep, todo, workers=workers)
    for _ in tqdm(done, total=len(todo), desc=name, unit="run"):
        pass
    return [json.loads(path.read_text())["result"] for path in jobs]


def save_results(out: Path, config: Any, runs: Sequence[dict[str, Any]], table: str) -> None:
    """Writes ``results.json`` and ``table.md``, and shows the table.

    Args:
        out: folder to write to.
        config: a dataclass, the settings of the grid.
        runs: what the jobs returned.
        table: Markdown.
    """
    results = {
        "config": dataclasses.asdict(config),
        "versions": versions(),
        "runs": runs,
    }
    write_whole(out / "results.json", json.dumps(results, default=str))
    write_whole(out / "table.md", table)
    print(f"\n{table}\nResults are in {out}.")


def _run_and_keep(run: Callable[..., dict[str, Any]], path: Path, arguments: Any) -> None:
    kept = {"arguments": _plain(arguments), "result": run(*arguments)}
    write_whole(path, json.dumps(kept))


def _check_same(path: Path, arguments: Any) -> None:
    kept, wanted = json.loads(path.read_text())["arguments"], _plain(arguments)
    try:
        refuse_other_settings(_by_name(kept), _by_name(wanted))
    except ValueError as error:
        raise ValueError(
            f"out must be a folder of the same run, got {str(path)!r}: {error}."
        ) from error


def _by_name(arguments: list[Any]) -> dict[str, Any]:
    named: dict[str, Any] = {}
    for index, value in enumerate(arguments):
        named.update(value if isinstance(value, dict) else {f"argument {index}": value})
    return named


def _plain(arguments: Any) -> Any:
    """Arguments as JSON gives them back, without paths, which say where and not what."""

    def describe(value: Any) -> Any:
        if dataclasses.is_dataclass(value) and not isinstance(value, type):
            fields = dataclasses.asdict(value).items()
            return {name: part for name, part in fields if not isinstance(part, Path)}
        return str(value)

    return json.loads(json.dumps(arguments, default=describe))
