"""The paper's experiment, made small: its files, how it resumes, what it counts."""

import dataclasses
import json

import numpy as np
import pytest
import torch

from experiments.grid import missing
from experiments.paper import CELLS, Config, jobs, main, make_agent, make_env, per_epoch, table

SMALL = {"seeds": (0,), "epochs": 1, "jobs": 2, "eval_episodes": 1}


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    config = Config(**SMALL, out=tmp_path_factory.mktemp("paper"))
    main(config)
    return config


@pytest.mark.parametrize(
    "wrong", [{"epochs": 0}, {"eval_episodes": 0}, {"cost_limit": float("nan")}], ids=str
)
def test_what_is_refused(wrong):
    (name,) = wrong
    with pytest.raises(ValueError, match=name):
        Config(**wrong)


@pytest.mark.slow
def test_what_it_leaves(finished):
    results = json.loads((finished.out / "results.json").read_text())
    assert {run["cell"] for run in results["runs"]} == set(CELLS)
    for run in results["runs"]:
        assert len(run["history"]) == 1
        # The multiplier starts at 1 and falls, since nobody has reached the limit yet.
        multiplier = run["history"][-1]["multiplier"]
        assert multiplier == 0 if run["cell"].endswith(" PPO") else 0.8 < multiplier <= 1
    assert (finished.out / "table.md").read_text() == table(results["runs"])
    assert (finished.out / "curves.png").stat().st_size > 10_000


@pytest.mark.slow
def test_only_what_is_missing_is_run(finished):
    path = finished.out / "AR1-PPO-0.json"
    stamps = {other: other.stat().st_mtime_ns for other in finished.out.glob("AR*.json")}
    assert not missing(jobs(finished))
    first = json.loads(path.read_text())["result"]
    path.unlink()
    assert missing(jobs(finished)) == [path]
    assert len(missing(jobs(dataclasses.replace(finished, seeds=(0, 1))))) == 5
    main(finished)
    assert {other for other in stamps if other.stat().st_mtime_ns != stamps[other]} == {path}
    # Run again, it comes out the same.
    again = json.loads(path.read_text())["result"]
    assert again["history"] == first["history"]
    assert again["evaluation"] == first["evaluation"]


def test_means_are_of_the_episodes_that_ended():
    history = [
        {"episodes": 2, "cost": 10.0},
        {"episodes": 0, "cost": 0.0},
        {"episodes": 4, "cost": 2.0},
    ]
    np.testing.assert_array_equal(per_epoch({"history": history}, "cost"), [5.0, np.nan, 0.5])


def test_networks_are_those_of_the_paper():
    env = make_env("AR2", 1, 0)
    actor, loss = make_agent(env)
    policy = actor(env.reset())
    env.close()
    torch.testing.assert_close(policy["scale"], torch.full((1, 7), np.exp(-0.5)).float())
    shapes = [tuple(p.shape) for p in loss.critic_network_params.values(True, True)]
    assert sorted(shapes) == [(1,), (1, 64), (64,), (64,), (64, 8), (64, 64)]
