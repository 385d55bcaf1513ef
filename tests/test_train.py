"""The main job, made small: what it leaves behind, and what it refuses."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from PIL import Image
from torchrl.checkpoint import Checkpoint

from experiments.agent import make_agent
from experiments.report import table
from experiments.train import MULTIPLIER_RULES, Config, make_env

ROOT = Path(__file__).parent.parent


def run(*arguments):
    return subprocess.run(
        [sys.executable, "-m", "experiments.train", *map(str, arguments)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=280,
        check=False,
    )


def make_loss():
    torch.manual_seed(0)
    env = make_env(Config(), num_envs=1, seed=0)
    _, loss = make_agent(env, gamma=0.97)
    env.close()
    return loss


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    out = tmp_path_factory.mktemp("run")
    done = run(
        "--frames", 2048, "--frames-per-batch", 1024, "--envs", 8, "--workers", 1,
        "--eval-episodes", 32, "--out", out,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-3000:]
    return out, done.stdout


def test_what_it_leaves(finished):
    out, stdout = finished
    results = json.loads((out / "results.json").read_text())
    assert list(results["algorithms"]) == ["ppo", "ppo-lagrangian"]
    for name, run in results["algorithms"].items():
        assert [row["frames"] for row in run["history"]] == [1024, 2048]
        for estimate, low, high in run["evaluation"].values():
            assert low <= estimate <= high
        with Image.open(out / name / "policy.gif") as film:
            assert film.n_frames > 10
        assert list((out / "logs").rglob(f"*{name}*"))
    for picture in ("curves.png", "scene.png"):
        with Image.open(out / picture) as image:
            assert image.width >= 640
    assert table(results) in stdout
    assert (out / "table.md").read_text() == table(results)


def test_ppo_has_no_multiplier_and_its_brother_has(finished):
    out, _ = finished
    runs = json.loads((out / "results.json").read_text())["algorithms"]
    multipliers = {
        name: [row["multiplier/collision"] for row in run["history"]] for name, run in runs.items()
    }
    assert multipliers["ppo"] == [0, 0]
    assert multipliers["ppo-lagrangian"][-1] > 0


def test_checkpoint_holds_the_loss(finished):
    out, _ = finished
    results = json.loads((out / "results.json").read_text())
    loss = make_loss()
    before = {key: value.clone() for key, value in loss.state_dict().items()}
    Checkpoint(loss=loss).load(out / "ppo-lagrangian" / "checkpoint")
    last = results["algorithms"]["ppo-lagrangian"]["history"][-1]
    assert loss.lagrange_multiplier.item() == pytest.approx(last["multiplier/collision"])
    assert not torch.equal(
        before["actor_network_params.module.0.module.0.0.weight"],
        loss.state_dict()["actor_network_params.module.0.module.0.0.weight"],
    )


def test_a_run_is_not_written_over(finished):
    out, _ = finished
    before = (out / "results.json").read_bytes()
    done = run("--out", out)
    assert done.returncode != 0
    assert "out must be a new or empty folder" in done.stderr
    assert (out / "results.json").read_bytes() == before


def test_help_names_the_options():
    done = run("--help")
    assert done.returncode == 0
    for option in (
        "arm", "action", "algorithms", "cost-limit", "frames", "envs", "workers", "seed", "out",
        "logger", "multiplier-rule",
    ):  # fmt: skip
        assert f"--{option}" in done.stdout


def test_multiplier_rules():
    """An episode 2 above the limit: 0.1 times 2, with proportional control 5 times as much more."""
    multiplier = {}
    for name, rule in MULTIPLIER_RULES.items():
        loss = make_loss()
        rule(loss, 0.1, cost_limit=1.0).step(torch.tensor([[3.0]]))
        multiplier[name] = loss.lagrange_multiplier.item()
    assert multiplier == pytest.approx({"dual-ascent": 0.2, "pid": 1.2})


def test_agent_knows_the_scale_of_what_it_sees_and_predicts():
    config = Config(paper=True, observation="paper")
    torch.manual_seed(0)
    env = make_env(config, num_envs=4, seed=0)
    actor, loss = make_agent(env, gamma=0.99, multiplier_init=2.0)
    with torch.no_grad():
        seen = env.rollout(100, break_when_any_done=False)
        standardized = actor.get_submodule("0.module.0.0")(seen["observation"])
        value = loss.critic_network(seen.clone())["state_value"]
    env.close()
    # Of other episodes than the ones it was fitted to: the target differs, the rest does not.
    assert standardized.mean().abs() < 0.5
    assert 0.2 < standardized[..., :3].std() < 3
    # A step costs about -0.6 of reward; the untrained prediction is small in that unit.
    assert 0 < value.abs().mean() < 5
    assert loss.lagrange_multiplier.item() == 2.0
    # The paper's actions are not bounded, so the policy is a plain Gaussian.
    assert type(actor.get_dist(seen)).__name__ == "IndependentNormal"


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"frames": 0}, "frames must be at least 1, got 0"),
        ({"workers": 0}, "workers must be at least 1, got 0"),
        ({"envs": 5, "workers": 2}, "envs must be a multiple of workers, got 5 and 2"),
        ({"envs": 6, "workers": 2}, "frames_per_batch must be a multiple of envs"),
        ({"pessimism": -1.0}, "pessimism must not be negative, got -1.0"),
        ({"multiplier_init": -1.0}, "multiplier_init must not be negative, got -1.0"),
        ({"gamma": 1.0}, "gamma must be between 0 and 1, got 1.0"),
        ({"minibatch": 0}, "minibatch must be at least 1, got 0"),
        ({"learning_rate": float("nan")}, "learning_rate must be positive, got nan"),
        ({"cost_limit": -1.0}, "cost_limit must not be negative, got -1.0"),
        ({"algorithms": ()}, "algorithms must name at least one"),
    ],
)
def test_bad_settings(settings, message):
    with pytest.raises(ValueError, match=message):
        Config(**settings)
