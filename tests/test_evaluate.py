"""``python -m experiments.evaluate``: in the environment of the training, and in others."""

import json
import sys
from pathlib import Path

import pytest
from PIL import Image
from tensordict.nn import TensorDictModule
from torchrl.data import Unbounded
from torchrl.envs import TransformedEnv
from torchrl.modules import MLP
from trained import train_briefly

from experiments import evaluate
from torchrl_safe.envs.gym import SafeGymEnv
from torchrl_safe.policy import save_policy


@pytest.fixture(scope="module")
def policy(tmp_path_factory):
    """The file of a policy that was trained for two batches."""
    return train_briefly(tmp_path_factory.mktemp("run"))[1]


@pytest.mark.integration
def test_evaluation_in_the_environment_of_the_training(policy, tmp_path, capsys):
    out, video = tmp_path / "out", tmp_path / "film.webp"
    settings = {"episodes": 3, "envs": 2, "video": video, "shown": 1, "out": out}
    evaluate.main(evaluate.Config(policy, **settings))
    shown = capsys.readouterr().out
    assert "episodes above the limit of collision | cost of the worst tenth: collision" in shown
    assert "Cost limit 0.5" in shown
    assert (out / "table.md").read_text() in shown
    figures = json.loads((out / "results.json").read_text())["evaluation"]
    assert 1 <= figures["steps"][0] <= 40
    with Image.open(video) as film:
        assert film.n_frames > 10


MINE = """
import gymnasium
from torchrl.envs import RenameTransform, TransformedEnv, Compose, GymEnv, StepCounter
from torchrl_safe.envs import ArmEnv, CostToReward, JointDelta, Speed

def arm(num_envs):
    return ArmEnv(num_envs=num_envs, costs={"fast": Speed(0.1)}, max_episode_steps=5)

def joints(num_envs):
    return ArmEnv(num_envs=num_envs, action=JointDelta())

def pendulum(num_envs):
    cost = RenameTransform(["observation"], ["cost"], create_copy=True)
    return TransformedEnv(GymEnv("Pendulum-v1"), Compose(cost, CostToReward(), StepCounter(5)))
"""


@pytest.fixture
def mine(tmp_path, monkeypatch):
    (tmp_path / "mine.py").write_text(MINE)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    yield
    sys.modules.pop("mine", None)


def test_evaluation_in_an_environment_of_ones_own(mine, policy, tmp_path, capsys):
    settings = {"episodes": 2, "envs": 2, "cost_limits": (3.0,)}
    evaluate.main(evaluate.Config(policy, env="mine:arm", **settings))
    shown = capsys.readouterr().out
    assert "episode cost: fast" in shown
    assert "| 5.00 [5.00, 5.00] |" in shown, "the time limit of that environment"
    assert "Cost limit 3;" in shown


def test_costs_of_a_gymnasium_environment_have_their_names():
    env = SafeGymEnv("counting:Counting-v0", cost_keys=["cost", ("costs", "heat")])
    assert evaluate.cost_names(env) == ("cost", "costs.heat")
    assert evaluate.cost_names(TransformedEnv(env)) == ("cost", "costs.heat")
    env.close()


def test_evaluation_in_any_environment_with_a_cost(mine, tmp_path, capsys):
    actor = TensorDictModule(MLP(3, 1), ["observation"], ["action"])
    # What a loop of one's own may note: a number of another program's.
    save_policy(tmp_path / "policy.pt", actor, Unbounded(3), settings={"cost_limit": 0.5})
    settings = {"env": "mine:pendulum", "episodes": 2, "cost_limits": (0.0, 2.0, 3.0)}
    evaluate.main(evaluate.Config(tmp_path / "policy.pt", max_steps=5, **settings))
    with pytest.raises(
        ValueError, match=r"env must be given .* does not say what it was trained in"
    ):
        evaluate.main(evaluate.Config(tmp_path / "policy.pt", **{**settings, "env": None}))
    shown = capsys.readouterr().out
    assert "episode cost: cost 2" in shown
    assert "success" not in shown
    with pytest.raises(ValueError, match="max_steps must let every episode end, got 4, after"):
        evaluate.main(evaluate.Config(tmp_path / "policy.pt", max_steps=4, **settings))
    with pytest.raises(ValueError, match=r"cost_limits must be one for each of the 3 .* got \(\)"):
        evaluate.main(
            evaluate.Config(tmp_path / "policy.pt", max_steps=5, **{**settings, "cost_limits": ()})
        )


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"episodes": 1}, "episodes must be a whole number of at least 2, got 1"),
        ({"cost_limits": (-1.0,)}, "cost_limits must not be negative, got .-1.0"),
        ({"cost_limits": (1.0, 2.0)}, "cost_limits must be one for each of the 1 costs of env"),
        ({"video": Path("a.mov")}, "video must end in .gif or .webp, got 'a.mov'"),
        ({"gui": True, "env": "mine:arm"}, "gui must not be given with env"),
        ({"gui": True, "physics": "mujoco"}, "gui needs physics=bullet, got 'mujoco'"),
        ({"env": "mine"}, "env must be module:function, got 'mine'"),
        ({"env": "mine:joints"}, "env must have actions of shape .3,., .* got .7,."),
    ],
)
def test_what_is_refused(settings, message, mine, policy):
    with pytest.raises(ValueError, match=message):
        evaluate.main(evaluate.Config(policy, **{"envs": 1, **settings}))
