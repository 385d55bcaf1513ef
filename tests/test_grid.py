"""Grids of runs: every job once, side by side, and nothing half written."""

import json
import os

import pytest

from experiments.grid import missing, run_grid


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
    assert json.loads((tmp_path / "results" / "2.json").read_text()) == {"square": 4}
