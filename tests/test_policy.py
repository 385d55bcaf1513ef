"""A policy in a file of its own: saved, loaded elsewhere, played with; other files are refused."""

import json
import pickle
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from PIL import Image
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type

from experiments import evaluate
from experiments.agent import ActorSpec, make_actor
from experiments.policy import load_policy, save_policy
from experiments.train import Config, train

ROOT = Path(__file__).parent.parent
OBSERVATIONS = torch.randn(64, 40, generator=torch.Generator().manual_seed(0))

# What a user would run, in a process that has seen neither the training nor its networks.
ACT = """
import sys, torch
from pathlib import Path
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type
from experiments.policy import load_policy

saved = load_policy(Path(sys.argv[1]))
observations = torch.load(sys.argv[2], weights_only=True)
with set_exploration_type(ExplorationType.DETERMINISTIC):
    actions = saved.actor(TensorDict(observation=observations, batch_size=[64]))["action"]
torch.save(actions, sys.argv[3])
"""


def act(actor):
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        return actor(TensorDict(observation=OBSERVATIONS, batch_size=[64]))["action"]


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A policy that was trained for two batches, and its file."""
    out = tmp_path_factory.mktemp("run")
    config = Config(frames=128, frames_per_batch=64, envs=8, workers=1, epochs=1, out=out)
    actor, _ = train(config, "ppo-lagrangian", progress=False)
    return actor, out / "ppo-lagrangian" / "policy.pt"


def test_acts_the_same_in_a_fresh_process(trained, tmp_path):
    actor, file = trained
    torch.save(OBSERVATIONS, tmp_path / "observations.pt")
    arguments = [file, tmp_path / "observations.pt", tmp_path / "actions.pt"]
    subprocess.run([sys.executable, "-c", ACT, *map(str, arguments)], cwd=ROOT, check=True)
    actions = torch.load(tmp_path / "actions.pt", weights_only=True)
    assert torch.equal(actions, act(actor))
    assert len(actions.unique()) > 64


@pytest.mark.parametrize("bounded", [True, False])
@pytest.mark.parametrize("noise", ["same", "chosen", "none"])
def test_every_kind_of_policy(noise, bounded, tmp_path):
    spec = ActorSpec(observations=40, actions=7, noise=noise, bounded=bounded)
    actor = make_actor(spec, torch.rand(40), torch.rand(40))
    save_policy(tmp_path / "policy.pt", actor, spec, {"note": ["a", 1, None]})
    saved = load_policy(tmp_path / "policy.pt")
    assert saved.spec == spec
    assert saved.settings == {"note": ["a", 1, None]}
    assert act(actor).shape == (64, 7)
    assert torch.equal(act(saved.actor), act(actor))
    assert not any(parameter.requires_grad for parameter in saved.actor.parameters())


class Exploit:
    """What pickle would call while it loads."""

    def __reduce__(self):
        return Path.touch, (Path("exploited"),)


def write(path, contents):
    path.write_bytes(contents)


FOREIGN = {
    "empty": lambda path, good: write(path, b""),
    "text": lambda path, good: write(path, b"to whom it may concern"),
    "torn": lambda path, good: write(path, good[: len(good) // 2]),
    "pickle": lambda path, good: write(path, pickle.dumps(Exploit())),
    "code": lambda path, good: torch.save({"weights": Exploit()}, path),
    "other": lambda path, good: torch.save({"weights": torch.zeros(3)}, path),
    "tensor": lambda path, good: torch.save(torch.zeros(3), path),
}


@pytest.mark.parametrize("spoil", FOREIGN.values(), ids=FOREIGN.keys())
def test_other_files_are_refused(spoil, trained, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    spoil(tmp_path / "policy.pt", trained[1].read_bytes())
    with pytest.raises(ValueError, match="policy must be a file that save_policy wrote, got '/"):
        load_policy(tmp_path / "policy.pt")
    assert not Path("exploited").exists(), "nothing in a file is run"


def test_version_and_missing_file(trained, tmp_path):
    contents = torch.load(trained[1], weights_only=True)
    torch.save({**contents, "version": 2}, tmp_path / "policy.pt")
    with pytest.raises(ValueError, match=r"policy must be of version 1, got .* of version 2"):
        load_policy(tmp_path / "policy.pt")
    with pytest.raises(FileNotFoundError):
        load_policy(tmp_path / "none.pt")


def test_an_old_file_stays_until_the_new_one_is_whole(trained, tmp_path):
    _, file = trained
    copy = tmp_path / "policy.pt"
    copy.write_bytes(file.read_bytes())
    saved = load_policy(copy)
    with pytest.raises((AttributeError, pickle.PicklingError)):
        save_policy(copy, saved.actor, saved.spec, {"cannot be written": lambda: None})
    assert list(tmp_path.iterdir()) == [copy]
    assert copy.read_bytes() == file.read_bytes()


# ---------------------------------------------------------------- python -m experiments.evaluate


def test_evaluation_in_the_environment_of_the_training(trained, tmp_path, capsys):
    _, file = trained
    out, video = tmp_path / "out", tmp_path / "film.webp"
    settings = {"episodes": 3, "envs": 2, "video": video, "shown": 1, "out": out}
    evaluate.main(evaluate.Config(file, **settings))
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


def test_evaluation_in_an_environment_of_ones_own(mine, trained, tmp_path, capsys):
    settings = {"episodes": 2, "envs": 2, "cost_limits": (3.0,)}
    evaluate.main(evaluate.Config(trained[1], env="mine:arm", **settings))
    shown = capsys.readouterr().out
    assert "episode cost: fast" in shown
    assert "| 5.00 [5.00, 5.00] |" in shown, "the time limit of that environment"
    assert "Cost limit 3;" in shown


def test_evaluation_in_any_environment_with_a_cost(mine, tmp_path, capsys):
    spec = ActorSpec(observations=3, actions=1, noise="same", bounded=True)
    save_policy(tmp_path / "policy.pt", make_actor(spec), spec, {})
    settings = {"env": "mine:pendulum", "episodes": 2, "cost_limits": (0.0, 2.0, 3.0)}
    evaluate.main(evaluate.Config(tmp_path / "policy.pt", max_steps=5, **settings))
    shown = capsys.readouterr().out
    assert "episode cost: 2" in shown
    assert "success" not in shown
    with pytest.raises(ValueError, match="max_steps must let every episode end, got 4, after"):
        evaluate.main(evaluate.Config(tmp_path / "policy.pt", max_steps=4, **settings))
    with pytest.raises(ValueError, match="max_steps must be given"):
        evaluate.main(evaluate.Config(tmp_path / "policy.pt", **settings))
    with pytest.raises(ValueError, match=r"cost_limits must be one for each of the 3 .* got \(\)"):
        evaluate.main(
            evaluate.Config(tmp_path / "policy.pt", max_steps=5, **{**settings, "cost_limits": ()})
        )


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"episodes": 1}, "episodes must be at least 2, got 1"),
        ({"cost_limits": (-1.0,)}, "cost_limits must not be negative, got .-1.0"),
        ({"cost_limits": (1.0, 2.0)}, "cost_limits must be one for each of the 1 costs of env"),
        ({"video": Path("a.mov")}, "video must end in .gif or .webp, got 'a.mov'"),
        ({"gui": True, "env": "mine:arm"}, "gui must not be given with env"),
        ({"env": "mine"}, "env must be module:function, got 'mine'"),
        ({"env": "mine:joints"}, "env must have actions of width 3, .* got 7"),
    ],
)
def test_what_is_refused(settings, message, mine, trained):
    with pytest.raises(ValueError, match=message):
        evaluate.main(evaluate.Config(trained[1], **{"envs": 1, **settings}))
