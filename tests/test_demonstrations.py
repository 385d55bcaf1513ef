"""A policy that starts from what a pilot would do."""

import shutil

import pytest
import torch
from test_resume import assert_same_run
from torchrl.envs.utils import ExplorationType, set_exploration_type

from experiments.algorithms import ALGORITHMS
from experiments.config import KINDS, TASKS, Config, command_line
from experiments.demonstrations import (
    Imitation,
    Stage,
    fit_critics,
    standardize,
    start_from_demonstrations,
)
from experiments.environment import make_env
from experiments.learners import OnPolicyLearner
from experiments.train import SHARING, demonstrate, train, train_and_evaluate

pytestmark = pytest.mark.integration

SMALL = {
    "task": "push",
    "obstacles": "none",
    "physics": "mujoco",
    "envs": 4,
    "demonstrations": 256,
}


def make_training(algorithm="ppo", **settings):
    config = Config(**{**SMALL, **settings})
    torch.manual_seed(0)
    env = make_env(config, config.envs, 0, algorithm, training=True)
    return ALGORITHMS[algorithm].build(env, config), env, config


def follow(tensordict):
    """Does what is advised."""
    return tensordict.set("action", tensordict["advice"])


def test_advice_is_an_action_for_each_state():
    _, env, _ = make_training(task="pick-and-place")
    played = Stage(env).play(5, follow)
    env.close()
    assert played.shape == (4, 5)
    assert all(env.action_spec_unbatched.contains(each) for each in played["advice"].reshape(-1, 4))
    # With open fingers to begin with.
    torch.testing.assert_close(played["advice"][:, 0, 3], torch.full((4,), 0.9))
    torch.testing.assert_close(played["next", "observation"][:, 0], played["observation"][:, 1])


def test_who_follows_advice_succeeds():
    _, env, _ = make_training()
    played = Stage(env).play(60, follow)
    env.close()
    assert played["next", "success"].any(1).all()


def test_imitation_lowers_the_error():
    training, env, _ = make_training()
    imitation = Imitation(training.actor)
    imitation.add(Stage(env).play(32, follow))
    env.close()
    standardize(training.loss, imitation.seen["observation"])

    def error():
        chosen = training.actor.get_dist(imitation.seen).deterministic_sample
        return (chosen - imitation.seen["action"]).square().mean().item()

    first = error()
    imitation.learn(200 * 1024)
    assert error() < 0.1 * first
    assert len(imitation.seen) == 4 * 32


def test_observations_are_standardized_by_what_was_demonstrated():
    training, env, _ = make_training()
    seen = (
        Stage(env)
        .play(40, follow)["observation"]
        .reshape(-1, env.observation_spec["observation"].shape[-1])
    )
    env.close()
    # What never changed there is not seen at all when it does.
    seen[:, 3] = 0.7
    standardize(training.loss, seen)
    for network in (training.actor.module[0].module[0], training.loss.critic_network.module[0]):
        shown = network[0](seen)
        assert shown.mean(0).abs().max() < 0.5
        assert 0.5 < shown.std(0).max() < 1.01
        assert not network[0](torch.randn_like(seen))[:, 3].any()


def test_critics_are_fitted_and_the_policy_stays():
    training, env, _ = make_training(gamma=0.9)
    played = Stage(env).play(40, training.actor)
    env.close()
    before = [parameter.clone() for parameter in training.actor.parameters()]

    def error():
        data = training.loss.estimate_advantages(played.clone(False))
        return (data["state_value"] - data["value_target"]).square().mean().item()

    first = error()
    fit_critics(training.loss, played, 2e-3)
    assert error() < 0.5 * first
    assert all(map(torch.equal, before, training.actor.parameters()))
    assert all(parameter.grad is None for parameter in training.actor.parameters())


def test_the_penalty_of_a_loss_does_not_adapt_to_a_policy_that_rests():
    training, env, _ = make_training("kl-ppo-lagrangian")
    played = Stage(env).play(10, training.actor)
    env.close()
    before = training.loss.beta.clone()
    fit_critics(training.loss, played, 2e-3)
    assert torch.equal(training.loss.beta, before)


def test_every_algorithm_starts_from_the_same_policy():
    weights = []
    for algorithm in ("ppo-lagrangian", "cpo"):
        training, env, config = make_training(algorithm, episode_steps=20)
        start_from_demonstrations(training, env, config)
        env.close()
        weights.append(training.actor.state_dict())
    for other in weights[1:]:
        for name, weight in weights[0].items():
            assert torch.equal(weight, other[name]), name


def test_acting_is_random_and_goes_on():
    """Two calls in a row are one: episodes do not begin anew."""
    training, env, _ = make_training()
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        certain = training.actor(env.reset())["action"]
    stage = Stage(env)
    assert not torch.equal(stage.play(3, training.actor)["action"][:, 0], certain)
    stage.play(4, training.actor)
    assert env.base_env.arm_state.step.tolist() == [7] * 4
    env.close()


SHORT = {
    **SMALL,
    "frames": 128,
    "frames_per_batch": 64,
    "epochs": 1,
    "episode_steps": 20,
    "cost_limit": 0.01,
    "obstacles": "in-front",
    "checkpoint_every": 1,
    "resume": True,
}


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """Results and folder of a run of PPO."""
    folder = tmp_path_factory.mktemp("whole")
    return train(Config(**SHORT, out=folder), "ppo", progress=False), folder


def test_a_run_that_goes_on_is_the_run_that_was_not_stopped(tmp_path, whole):
    """It does not begin with demonstrations again."""
    expected, folder = whole
    part = shutil.copytree(folder, tmp_path / "part")
    for last in sorted((part / "ppo" / "checkpoints").glob("*.torchrl"))[1:]:
        last.unlink()
    resumed = train(Config(**SHORT, out=part), "ppo", progress=False)
    assert_same_run(expected, resumed, folder, part)


def test_what_one_algorithm_has_begun_with_the_other_takes(tmp_path, whole, monkeypatch):
    both, alone = shutil.copytree(whole[1], tmp_path / "both"), tmp_path / "alone"
    expected = train(Config(**SHORT, out=alone), "ppo-lagrangian", progress=False)
    monkeypatch.setattr("experiments.train.start_from_demonstrations", None)
    taken = train(Config(**SHORT, out=both), "ppo-lagrangian", progress=False)
    for log in (both / "logs").rglob("*.csv"):
        if not (alone / log.relative_to(both)).exists():
            log.unlink()
    assert_same_run(expected, taken, alone, both)


@pytest.mark.slow
def test_workers_collect_with_the_policy_that_was_taught(tmp_path, monkeypatch):
    calm = {"first_log_std": -6.0, "last_log_std": -6.0, "learning_rate": 1e-9}
    short = {
        "frames": 64,
        "frames_per_batch": 64,
        "epochs": 1,
        "episode_steps": 20,
        "eval_episodes": 4,
    }
    config = Config(**SMALL, **calm, **short, workers=2, out=tmp_path)
    before = []
    learn = OnPolicyLearner.learn
    monkeypatch.setattr(
        OnPolicyLearner, "learn", lambda self, batch: (before.append(batch), learn(self, batch))
    )
    actor, _ = train(config, "ppo", progress=False)
    (batch,) = before
    chosen = actor.get_dist(batch).deterministic_sample
    assert batch["action"].abs().max() > 0.5
    torch.testing.assert_close(batch["action"], chosen, rtol=0, atol=0.05)


def test_settings_of_a_task_are_those_of_its_kind():
    for name, kind in TASKS.items():
        config = command_line(["--task", name, "--seed", "3"])
        assert (config.task, config.seed) == (name, 3)
        for option, value in KINDS[kind].items():
            assert getattr(config, option) == value
    assert command_line([]).demonstrations == 0
    assert command_line(["--task=push", "--demonstrations", "0"]).demonstrations == 0


@pytest.mark.slow
def test_pushing_is_learnt(tmp_path):
    """In two minutes, from nothing: most cubes are pushed to their goals."""
    chosen = {**KINDS[TASKS["push"]], **SMALL, "envs": 64, "demonstrations": 49_152}
    config = Config(**{**chosen, "frames": 16_384}, out=tmp_path)
    results = train_and_evaluate(config, "ppo", progress=False)
    assert results["evaluation"]["success"][0] >= 0.8


def test_the_scale_of_cost_advantages_is_begun_with_too(tmp_path):
    """It weighs the multiplier, and falls so slowly that its start counts for a whole training."""
    scales = []
    for algorithm in SHARING:
        training, env, config = make_training(algorithm, obstacles="in-front", out=tmp_path)
        env.close()
        demonstrate(config, algorithm, training)
        scales.append(training.loss.cost_advantage_scale)
    assert scales[0] > 0
    assert torch.equal(*scales)
