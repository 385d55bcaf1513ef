"""The policies that come with the package, and the script that puts them there."""

import dataclasses
import json
import re
from pathlib import Path

import numpy as np
import pytest
import torch
from tensordict.nn import TensorDictModule
from torchrl.data import Composite, Unbounded
from torchrl.modules import MLP

import torchrl_safe
from experiments import evaluate, ship, suite
from experiments.config import suite_config
from torchrl_safe import policy
from torchrl_safe.envs import SUITE
from torchrl_safe.policy import load_policy, save_policy, shipped_policies

pytestmark = pytest.mark.integration

FOLDER = Path(torchrl_safe.__file__).parent / "policies"
CARDS = shipped_policies()
NAME = "panda-reach-human"
each_policy = pytest.mark.parametrize("name", CARDS)


def test_each_task_has_one():
    assert {path.stem for path in FOLDER.glob("*.pt")} == set(CARDS) == set(SUITE)


@each_policy
def test_each_plays_as_its_card_says(name):
    """64 other episodes are within four standard errors of those of the card.

    Not the mean costs: a rare episode in which the arm stays in contact outweighs all others.
    """
    card = CARDS[name]
    saved = load_policy(name)
    config = evaluate.Config(Path(name), episodes=64, envs=32, seed=4_000_000)
    env = evaluate.factory(config, saved)(num_envs=32)
    figures = evaluate.play(env, saved, config, tuple(card["cost_limits"].values()))
    env.close()
    for figure in ("success", *(f"any/{cost}" for cost in card["cost_limits"])):
        (expected, low, high), found = card[figure], figures[figure][0]
        error = (high - low) / 3.92
        # Of fewer episodes the error is larger.
        both = error * (1 + card["episodes"] / config.episodes) ** 0.5
        assert abs(found - expected) < 4 * both + 0.02, figure
    for cost, limit in card["cost_limits"].items():
        assert card[f"cost/{cost}"][0] <= limit


@each_policy
def test_each_is_of_its_task_and_small(name):
    card, saved = CARDS[name], load_policy(name)
    assert card["task"] == name == saved.settings["suite_task"]
    assert card["cost_limits"] == SUITE[name].cost_limits
    file = FOLDER / f"{name}.pt"
    assert file.stat().st_size < 150_000
    assert saved(np.zeros(saved.observation_shape)).shape == saved.action_shape
    # Nothing of the machine that it was made on.
    assert "out" not in saved.settings
    assert not re.search(rb"/(work|home|root|tmp|usr)/", file.read_bytes())
    assert name in card["trained"]


def test_it_is_evaluated_by_its_name(capsys):
    evaluate.main(evaluate.Config(Path("panda-reach-in-front"), episodes=2, envs=2))
    assert "| panda-reach-in-front | " in capsys.readouterr().out


@pytest.fixture
def packaged(tmp_path, monkeypatch):
    """A folder of policies with one in it, in place of the package's."""
    monkeypatch.setattr(policy, "_SHIPPED", tmp_path)
    actor = TensorDictModule(MLP(4, 2), ["observation"], ["action"])
    save_policy(tmp_path / "mine.pt", actor, Composite(observation=Unbounded(4)))
    (tmp_path / "mine.json").write_text(json.dumps({"task": "mine"}))
    return tmp_path


def test_a_policy_has_a_name(packaged, monkeypatch):
    assert shipped_policies() == {"mine": {"task": "mine"}}
    for path in ("mine", Path("mine")):
        assert load_policy(path).observation_shape == (4,)
    # A file of that name comes first, a folder does not.
    monkeypatch.chdir(packaged)
    Path("mine").mkdir()
    assert load_policy("mine").observation_shape == (4,)
    Path("mine").rmdir()
    Path("mine").write_text("no policy")
    with pytest.raises(ValueError, match="path must be a file that save_policy wrote, got 'mine'"):
        load_policy("mine")


@pytest.mark.parametrize("name", ["yours", "../mine", "mine.pt", ""])
def test_other_names_are_refused(packaged, name):
    with pytest.raises(FileNotFoundError, match=r"must be a file or one of mine, got '"):
        load_policy(name)


def made_up(seed, success, cost):
    figures = {"success": success, "return": -1.0, "cost/collision": cost}
    return {"seed": seed, "evaluation": {name: [value, 0, 1] for name, value in figures.items()}}


def test_the_best_is_far_below_its_limits():
    """And succeeds in 99 % as many episodes as the best one within the limits."""
    runs = [made_up(0, 1.0, 0.6), made_up(1, 0.9, 0.5), made_up(2, 0.88, 0.1)]
    assert ship.best(runs, {"collision": 0.5})["seed"] == 1
    assert ship.best([*runs, made_up(3, 0.892, 0.4)], {"collision": 0.5})["seed"] == 3
    assert ship.best(runs[:1], {"collision": 0.5}) is None


def test_the_best_is_far_below_each_limit():
    runs = [made_up(seed, 1.0, cost) for seed, cost in ((0, 0.1), (1, 0.3))]
    for run, speed in zip(runs, (1.9, 1.0), strict=True):
        run["evaluation"]["cost/speed"] = [speed, 0, 3]
    assert ship.best(runs, {"collision": 0.5, "speed": 2.0})["seed"] == 1


def test_what_is_shipped(tmp_path, capsys):
    """A policy and its card, without where it was made; none where no run keeps the limits."""
    env = SUITE[NAME].make_env(num_envs=1)
    width = env.observation_spec["observation"].shape[-1]
    env.close()
    actor = TensorDictModule(MLP(width, 3, num_cells=[4]), ["observation"], ["action"])
    config = suite_config(NAME, out=tmp_path, seed=7, physics="mujoco")
    settings = json.loads(json.dumps(dataclasses.asdict(config), default=str))
    file = suite.folder(tmp_path, NAME, 7) / "ppo-lagrangian" / "policy.pt"
    spec = Composite(observation=Unbounded(width))
    save_policy(file, actor, spec, settings={**settings, "name": "ppo-lagrangian"})
    runs = [
        {"task": task, "algorithm": "ppo-lagrangian", "seed": 7, "evaluation": evaluation}
        for task, evaluation in (
            (NAME, {**made_up(7, 1.0, 0.1)["evaluation"], "cost/separation": [0.1, 0, 1]}),
            ("ur5-reach-moving", made_up(7, 1.0, 0.9)["evaluation"]),
        )
    ]
    (tmp_path / "results.json").write_text(json.dumps({"runs": runs}))
    ship.main(ship.Config(suite=tmp_path, episodes=32, out=tmp_path / "policies"))
    shown = capsys.readouterr().out
    assert "ur5-reach-moving: no run keeps every limit" in shown
    assert f"{NAME}: seed 7" in shown
    assert {path.name for path in (tmp_path / "policies").iterdir()} == {
        f"{NAME}.pt",
        f"{NAME}.json",
    }
    saved = load_policy(tmp_path / "policies" / f"{NAME}.pt")
    assert not {"out", "obstacles", "cost_limit"} & saved.settings.keys()
    assert saved.settings["suite_task"] == NAME
    for weight, own in zip(saved.weights.values(), actor.state_dict().values(), strict=True):
        assert torch.equal(weight, own)
    card = json.loads((tmp_path / "policies" / f"{NAME}.json").read_text())
    assert card["cost_limits"] == SUITE[NAME].cost_limits
    assert card["episodes"] == 32
    assert "--seeds 7" in card["trained"]
    assert {"success", "cost/separation", "worst/collision", "versions"} <= set(card)
