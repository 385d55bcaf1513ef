"""Grids of runs: every job once, side by side, and nothing half written."""

import dataclasses
import json
import multiprocessing
import os
from pathlib import Path

import pytest

from experiments.grid import missing, run_grid, save_results


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
