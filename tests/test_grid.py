"""Grids of runs: every job once, side by side, and nothing half written."""

import dataclasses
import json
import multiprocessing
import os
import signal
import threading
import time
from pathlib import Path

import pytest

from experiments.grid import missing, run_grid, save_results, side_by_side


@pytest.fixture(autouse=True)
def forked(monkeypatch):
    """Spawned processes, as the grids have, take seconds to import what they need."""
    context = multiprocessing.get_context("fork")
    monkeypatch.setattr(multiprocessing, "get_context", lambda _: context)


def square(number, folder):
    (folder / f"ran-{number}-{os.getpid()}").touch()
    if number < 0:
        raise ArithmeticError(f"no root for {number}")
    return {"square": number**2}


def make_jobs(folder, *numbers):
    return {folder / "results" / f"{number}.json": (number, folder) for number in numbers}


def test_results_come_in_the_order_of_the_jobs_and_each_job_runs_once(tmp_path):
    jobs = make_jobs(tmp_path, 3, 1)
    assert run_grid(square, jobs, workers=2, name="squares") == [{"square": 9}, {"square": 1}]
    jobs = make_jobs(tmp_path, 1, 2, 3)
    assert missing(jobs) == [tmp_path / "results" / "2.json"]
    results = run_grid(square, jobs, workers=1, name="squares")
    assert [result["square"] for result in results] == [1, 4, 9]
    assert len(list(tmp_path.glob("ran-*"))) == 3
    assert not missing(jobs)


def test_a_job_that_fails_leaves_the_others(tmp_path):
    with pytest.raises(ArithmeticError, match="no root for -1"):
        run_grid(square, make_jobs(tmp_path, 2, -1), workers=1, name="squares")
    assert [path.name for path in (tmp_path / "results").iterdir()] == ["2.json"]
    kept = json.loads((tmp_path / "results" / "2.json").read_text())
    assert kept["result"] == {"square": 4}


def fail_first(folder, number):
    (folder / f"began-{number}").touch()
    time.sleep(0.1)
    if number == 0:
        raise ArithmeticError(number)


def test_after_a_call_that_fails_no_other_begins(tmp_path):
    calls = [(tmp_path, number) for number in range(4)]
    with pytest.raises(ArithmeticError):
        list(side_by_side(fail_first, calls, workers=1))
    assert [path.name for path in tmp_path.iterdir()] == ["began-0"]


def sleep(folder, number):
    (folder / f"{number}-{os.getpid()}").touch()
    time.sleep(600)


def sleep_side_by_side(folder):
    for _ in side_by_side(sleep, [(folder, 0), (folder, 1)], workers=2):
        pass


def sleepers(folder):
    """The two processes, once both are there."""
    deadline = time.monotonic() + 60
    while len(found := list(folder.iterdir())) < 2:
        assert time.monotonic() < deadline, f"{found} began"
        time.sleep(0.01)
    return [int(path.name.split("-")[1]) for path in found]


def assert_gone(processes):
    for _ in range(1000):
        if not any(Path(f"/proc/{process}").exists() for process in processes):
            return
        time.sleep(0.01)
    raise AssertionError(f"still running: {processes}")


def test_an_interrupt_of_this_process_alone_ends_all(tmp_path):
    def interrupt():
        sleepers(tmp_path)
        os.kill(os.getpid(), signal.SIGINT)

    thread = threading.Thread(target=interrupt, daemon=True)
    thread.start()
    with pytest.raises(KeyboardInterrupt):
        sleep_side_by_side(tmp_path)
    thread.join()
    assert_gone(sleepers(tmp_path))


def test_none_is_left_when_this_process_is_killed(tmp_path):
    process = multiprocessing.get_context("fork").Process(
        target=sleep_side_by_side, args=(tmp_path,)
    )
    process.start()
    running = sleepers(tmp_path)
    process.kill()
    process.join()
    assert_gone(running)


@dataclasses.dataclass(frozen=True)
class Settings:
    factor: float
    out: Path


def multiply(settings, number):
    return {"product": settings.factor * number}


def test_results_of_other_settings_are_refused(tmp_path):
    """Where they are kept is no such setting."""

    def run(factor, folder):
        return run_grid(
            multiply,
            {tmp_path / "a.json": (Settings(factor, folder), 3)},
            workers=1,
            name="products",
        )

    assert run(2.0, tmp_path) == [{"product": 6.0}]
    assert run(2.0, tmp_path / "elsewhere") == [{"product": 6.0}]
    refused = r"out must be .*a\.json': the run has other settings: factor was 2.0 and is now 5.0\."
    with pytest.raises(ValueError, match=refused):
        run(5.0, tmp_path)


def test_results_are_written_with_settings_and_versions(tmp_path, capsys):
    save_results(tmp_path, Settings(2.0, tmp_path), [{"product": 6.0}], "| a |")
    results = json.loads((tmp_path / "results.json").read_text())
    assert results["config"] == {"factor": 2.0, "out": str(tmp_path)}
    assert results["runs"] == [{"product": 6.0}]
    assert {"torch", "torchrl"} <= set(results["versions"])
    assert (tmp_path / "table.md").read_text() == "| a |"
    assert "| a |" in capsys.readouterr().out
