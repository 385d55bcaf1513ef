"""`python -m experiments.safe_gym`: the recipe for any Gymnasium environment with a cost."""

import itertools
import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import get_args, get_type_hints
from unittest.mock import Mock

import gymnasium
import numpy as np
import pytest
import sliding
import torch
from torch.distributions import kl_divergence
from torchrl.envs.utils import ExplorationType, set_exploration_type

from experiments import compiling, evaluate, safe_gym, safe_gym_grid
from experiments.files import run_to_resume
from experiments.safe_gym import Config, Critic, Standardize, main, make_agent, make_env, train
from torchrl_safe.policy import load_policy

# Two episodes in each of two environments.
SMALL = Config(
    env="sliding:Slide-v0",
    cost_limit=(0.25,),
    frames=400,
    frames_per_batch=80,
    envs=2,
    epochs=2,
    minibatch=16,
    eval_episodes=4,
    checkpoint_every=2,
    random_frames=100,
    compile=False,
)


pytestmark = [pytest.mark.integration, pytest.mark.usefixtures("threads")]


def weights(agent):
    return torch.nn.ModuleList(agent).state_dict()


def test_the_results_and_the_policy(tmp_path):
    results = main(replace(SMALL, out=tmp_path))
    assert json.loads((tmp_path / "results.json").read_text())["history"] == results["history"]
    assert [row["frames"] for row in results["history"]] == [80, 160, 240, 320, 400]
    assert set(results["evaluation"]) == {"return", "steps", "cost/cost", "any/cost"}
    assert results["evaluation"]["steps"] == [20, 20, 20]
    with_noise = results["evaluation_with_noise"]
    assert set(with_noise) == set(results["evaluation"])
    assert with_noise["return"] != results["evaluation"]["return"]
    assert (tmp_path / "logs" / "ppo-lagrangian").is_dir()
    policy = load_policy(tmp_path / "policy.pt")
    assert policy.settings["env"] == SMALL.env
    # Its environment's own observations, far from 0 and of double precision.
    assert policy.observation_dtype == np.float64
    assert abs(policy(np.array([1000.0, 0.0]))).item() < 2
    assert policy(np.array([900.0, 0.0])) != policy(np.array([1100.0, 0.0]))


def test_a_stopped_run_goes_on_bit_for_bit(tmp_path, monkeypatch):
    whole, log = train(replace(SMALL, out=tmp_path / "whole"), progress=False)
    stopped = replace(SMALL, out=tmp_path / "stopped")
    with monkeypatch.context() as patch:
        add = safe_gym.Log.add

        def stop_in_the_fourth_batch(self, row):
            if len(self.rows) == 3:
                raise KeyboardInterrupt
            add(self, row)

        patch.setattr(safe_gym.Log, "add", stop_in_the_fourth_batch)
        with pytest.raises(KeyboardInterrupt):
            train(stopped, progress=False)
    with pytest.raises(FileExistsError, match=r"out must be a new or empty .* add --resume with"):
        main(stopped)
    agent, again = train(replace(stopped, resume=True), progress=False)
    assert again.rows == log.rows
    for name, value in weights(whole).items():
        assert torch.equal(weights(agent)[name], value), name


def test_statistics_are_of_all_observations_and_frozen_in_evaluation(tmp_path, monkeypatch):
    shown = []
    update = Standardize.update

    def remember(self, observation, *layers):
        shown.append(observation.reshape(-1, 2).double())
        update(self, observation, *layers)

    monkeypatch.setattr(Standardize, "update", remember)
    agent, _ = train(replace(SMALL, out=tmp_path), progress=False)
    seen = torch.cat(shown)
    assert len(seen) == SMALL.random_frames + SMALL.frames
    torch.testing.assert_close(agent.standardize.mean, seen.mean(0))
    torch.testing.assert_close(agent.standardize.std, seen.std(0, correction=0).float())
    before = agent.standardize.mean.clone()
    env = make_env(SMALL)
    safe_gym.evaluate(env, agent.actor, 2, seed=0)
    env.close()
    assert torch.equal(agent.standardize.mean, before)


def test_new_statistics_leave_the_networks_as_they_were():
    """The second observation hardly varied before: its weight stays, in the new unit."""
    standardize, layer = Standardize(2), torch.nn.Linear(2, 3)
    seen = torch.tensor([[0.0, 5.0], [2.0, 5.0]], dtype=torch.float64)
    standardize.update(seen)
    observations = torch.tensor([[0.5, 5.0], [-1.0, 5.0]])
    before, weight = layer(standardize(observations)), layer.weight.clone()
    standardize.update(torch.tensor([[1.0, 5.0], [5.0, 7.0]], dtype=torch.float64), [layer])
    assert standardize.mean.tolist() == [2.0, 5.5]
    torch.testing.assert_close(layer.weight[:, 1], weight[:, 1])
    torch.testing.assert_close(layer.weight[:, 0], weight[:, 0] * 3.5**0.5)
    # The second observation is now 5, or 0.58 deviations below its mean.
    moved = layer(standardize(observations)) - before
    torch.testing.assert_close(moved, (-weight[:, 1] / 3**0.5).expand(2, 3))


def test_statistics_change_neither_policy_nor_critics(tmp_path, monkeypatch):
    """Without a learning rate to speak of, nothing else does."""
    learn, means = safe_gym.Learner.learn, []

    def compare(self, batch):
        agent, rows = self.agent, batch["observation"].clone()
        networks = agent.explorer.module.policy, agent.critic.module, agent.cost_critic.module
        before = [network(rows) for network in networks]
        kl = learn(self, batch)
        after = [network(rows) for network in networks]
        torch.testing.assert_close(after, before, rtol=1e-4, atol=1e-4)
        means.append(agent.standardize.mean.clone())
        return kl

    monkeypatch.setattr(safe_gym.Learner, "learn", compare)
    train(replace(SMALL, learning_rate=1e-12, out=tmp_path), progress=False)
    assert len(means) == 5
    assert not torch.equal(means[0], means[4])


@pytest.mark.parametrize(
    "algorithm",
    [name for name in get_args(get_type_hints(Config)["algorithm"]) if name != "ppo-lagrangian"],
)
def test_algorithms(tmp_path, algorithm):
    config = replace(SMALL, algorithm=algorithm, frames=80, epochs=1, out=tmp_path)
    fresh = make_agent_of(config)
    agent, log = train(config, progress=False)
    assert len(log.rows) == 1
    moved = [
        not torch.equal(before, after)
        for before, after in zip(fresh.actor.parameters(), agent.actor.parameters(), strict=True)
    ]
    assert all(moved)
    assert ("multiplier/cost" in log.rows[0]) == (algorithm not in ("p3o", "ipo", "crpo"))


def make_agent_of(config):
    torch.manual_seed(config.seed)
    env = make_env(config)
    agent = make_agent(env, config.log_std)
    env.close()
    return agent


def test_several_costs(tmp_path):
    config = replace(
        SMALL,
        cost_keys=("costs.fast", "costs.far"),
        cost_limit=(0.5, 2.0),
        frames=160,
        out=tmp_path,
    )
    results = main(config)
    for name in config.cost_keys:
        assert f"cost/{name}" in results["evaluation"]
        assert f"multiplier/{name}" in results["history"][-1]


@pytest.mark.parametrize("algorithm", ["ppo-lagrangian", "crpo"])
def test_one_limit_for_several_costs(make_env, algorithm):
    keys = ("costs.fast", "costs.far")
    config = replace(SMALL, algorithm=algorithm, cost_keys=keys, cost_limit=(0.5,))
    env = make_env(safe_gym.make_env, config)
    loss = safe_gym.Learner(config, make_agent(env, config.log_std), batches=1).loss
    assert safe_gym.make_updater(config, loss).cost_limit.tolist() == [0.5, 0.5]


def test_resuming_where_no_run_is_says_so(tmp_path, capsys):
    config = replace(SMALL, frames=160, resume=True, out=tmp_path)
    said = f"There is no run in {tmp_path} to resume: this begins one."
    main(config)
    assert said in capsys.readouterr().out
    main(config)
    assert said not in capsys.readouterr().out


def test_resuming_with_other_settings_is_refused_before_there_is_a_checkpoint(
    tmp_path, monkeypatch
):
    config = replace(SMALL, out=tmp_path)
    with monkeypatch.context() as patch:
        patch.setattr(safe_gym.Log, "add", Mock(side_effect=KeyboardInterrupt))
        with pytest.raises(KeyboardInterrupt):
            train(config, progress=False)
    assert not list(tmp_path.glob("checkpoints/*.torchrl"))
    run_to_resume(replace(config, resume=True, eval_episodes=8), safe_gym.CHANGEABLE)
    with pytest.raises(
        ValueError, match=r"the run has other settings: gamma was .* and is now 0.5"
    ):
        run_to_resume(replace(config, resume=True, gamma=0.5), safe_gym.CHANGEABLE)


def test_an_option_that_cannot_be_used_leaves_the_folder_as_it_was(tmp_path):
    with pytest.raises(gymnasium.error.NameNotFound):
        main(replace(SMALL, env="sliding:Slidign-v0", out=tmp_path))
    assert not list(tmp_path.iterdir())


def test_a_run_of_another_script_is_not_overwritten(tmp_path):
    results = tmp_path / "results.json"
    results.write_text('{"config": {"envs": 32}, "algorithms": {}}')
    with pytest.raises(ValueError, match="the run has other settings: env was None and is now"):
        main(replace(SMALL, resume=True, out=tmp_path))
    assert "algorithms" in results.read_text()


@pytest.mark.parametrize(("limit", "expected"), [((3.0,), (3.0, 3.0)), ((1.0, 2.0), (1.0, 2.0))])
def test_the_limits_of_its_policies_are_known(limit, expected):
    """One may be for all costs."""
    saved = SimpleNamespace(settings={"cost_keys": ["heat", "wear"], "cost_limit": [*limit]})
    assert evaluate.cost_limits(evaluate.Config(Path("policy.pt")), saved) == expected


def test_on_our_own_arm(tmp_path):
    config = replace(
        SMALL,
        env="torchrl_safe.envs.gym:torchrl_safe/PandaReachInFront-v0",
        cost_keys=("costs.collision",),
        frames=160,
        eval_episodes=1,
        out=tmp_path,
    )
    results = main(config)
    assert results["evaluation"]["steps"] == [40, 40, 40]
    assert load_policy(tmp_path / "policy.pt").observation_shape == (40,)


def test_one_environment(tmp_path):
    _, log = train(replace(SMALL, envs=1, frames=80, out=tmp_path), progress=False)
    assert len(log.rows) == 1


def test_the_size_of_rewards_costs_and_limit_does_not_matter(tmp_path):
    agents, logs = zip(
        train(replace(SMALL, out=tmp_path / "one"), progress=False),
        train(
            replace(
                SMALL, env="sliding:SlideScaled-v0", cost_limit=(256.0,), out=tmp_path / "other"
            ),
            progress=False,
        ),
        strict=True,
    )
    one, other = (log.rows[-1] for log in logs)
    assert other["return"] == pytest.approx(128 * one["return"], rel=1e-3)
    assert other["cost/cost"] == pytest.approx(1024 * one["cost/cost"], rel=1e-3)
    assert one["multiplier/cost"] > 0
    assert other["multiplier/cost"] == pytest.approx(one["multiplier/cost"], rel=1e-3)
    for (name, value), scaled in zip(
        agents[0].actor.named_parameters(), agents[1].actor.parameters(), strict=True
    ):
        torch.testing.assert_close(scaled, value, rtol=1e-3, atol=1e-4, msg=name)


def test_units_change_and_predictions_stay():
    critic = Critic(Standardize(2), 2)
    torch.nn.init.normal_(critic.net[-1].weight)
    observation = torch.randn(50, 2, dtype=torch.float64)
    for scale in (1.0, 1e3, 1e-3):
        before = critic(observation)
        targets = scale * (torch.randn(50, 2) + torch.tensor([3.0, 0.0]))
        critic.change_units(targets)
        torch.testing.assert_close(critic.mean, targets.mean(0))
        # Single precision rounds the larger numbers in between.
        torch.testing.assert_close(critic(observation), before, rtol=0, atol=2e-3)


def test_units_of_costs_that_become_rare():
    critic = Critic(Standardize(2), 1)
    critic.change_units(torch.zeros(4, 1))
    assert critic.std.item() == 1
    targets = torch.tensor([[0.0], [2.0], [4.0], [6.0]])
    critic.change_units(targets)
    assert critic.mean.item() == 3
    assert critic.std.item() == pytest.approx((20 / 3) ** 0.5)
    critic.change_units(torch.zeros(4, 1))
    assert critic.std.item() == pytest.approx(0.98 * (20 / 3) ** 0.5)


def test_gradients_do_not_depend_on_the_unit():
    gradients = []
    for scale in (1.0, 1024.0):
        torch.manual_seed(0)
        critic = Critic(Standardize(2), 1)
        observation, targets = torch.randn(50, 2), scale * torch.randn(50, 1)
        critic.change_units(targets)
        # The same prediction in these units.
        critic.net[-1].weight.data.fill_(0.1)
        critic.net[-1].bias.data.zero_()
        (critic(observation) - targets).square().mean().backward()
        gradients.append([parameter.grad for parameter in critic.parameters()])
    for one, other in zip(*gradients, strict=True):
        torch.testing.assert_close(other, one)


def test_explores_as_the_policy(make_env):
    env = make_env(safe_gym.make_env, SMALL)
    agent = make_agent(env, 0.5)
    tensordict = env.reset()
    with set_exploration_type(ExplorationType.RANDOM):
        torch.manual_seed(1)
        drawn = torch.stack([agent.explorer(tensordict)["action"] for _ in range(20)])
        torch.manual_seed(1)
        expected = torch.stack([agent.actor(tensordict)["action"] for _ in range(20)])
    torch.testing.assert_close(drawn, expected)
    assert drawn.abs().max() > 1


def test_passes_end_where_the_policy_is_far(tmp_path):
    config = replace(SMALL, frames=80, epochs=1000, max_kl=0.01, learning_rate=0.003, out=tmp_path)
    _, log = train(config, progress=False)
    assert 0.01 < log.rows[0]["kl"] < 0.1


def test_divergence_is_that_of_the_distributions(make_env):
    env = make_env(safe_gym.make_env, SMALL)
    tensordict = env.reset()
    one, other = (make_agent(env, std).actor.get_dist(tensordict) for std in (0.0, 0.5))
    divergence = kl_divergence(one, other)
    assert divergence.shape == (2,)
    drawn = one.sample((20_000,))
    monte_carlo = (one.log_prob(drawn) - other.log_prob(drawn)).mean(0)
    torch.testing.assert_close(divergence, monte_carlo, rtol=0.1, atol=0.02)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"cost_limit": (1.0, 2.0)}, "cost_limit must be one number or one for each"),
        ({"cost_limit": (-1.0,)}, "cost_limit must not be negative"),
        ({"frames_per_batch": 81}, "multiple of envs"),
        ({"gamma": 1.0}, "gamma must be between 0 and 1"),
        ({"max_kl": 0.0}, "max_kl must be positive"),
        ({"epochs": 0}, "epochs must be a whole number of at least 1"),
        ({"seed": -1}, "seed must be at least 0 and below 2147483648, got -1"),
    ],
)
def test_settings_that_make_no_sense(changes, message):
    with pytest.raises(ValueError, match=message):
        replace(SMALL, **changes)


def test_what_is_not_finite_is_named(tmp_path, monkeypatch):
    nan = replace(SMALL, env="sliding:SlideNaN-v0", out=tmp_path)
    with pytest.raises(ValueError, match="env must return a finite reward in every step, got nan"):
        main(nan)
    monkeypatch.setattr(sliding.Slide, "observe", lambda self: np.array([np.inf, 0.0]))
    with pytest.raises(ValueError, match=r"must return a finite observation in .*, got inf"):
        main(replace(SMALL, out=tmp_path))
    assert not list(tmp_path.iterdir())


def test_costs_that_no_limit_bounds(tmp_path):
    """Gymnasium's HalfCheetah reports what its control costs as a negative reward."""
    with pytest.raises(ValueError, match=r"not cost less than 0, .*; \['costs.gain'\] cost -"):
        train(replace(SMALL, cost_keys=("cost", "costs.gain"), out=tmp_path), progress=False)


def test_episodes_that_never_end(tmp_path):
    """A checkpoint after 16 of the 20 steps of an episode begins it anew."""
    with pytest.raises(ValueError, match="env must have episodes that end, got none from 'sliding"):
        train(replace(SMALL, frames_per_batch=16, out=tmp_path), progress=False)


@pytest.mark.parametrize("name", ["SlideGrid", "SlideMatrix"])
def test_actions_that_are_neither_a_vector_nor_discrete(name, tmp_path):
    with pytest.raises(ValueError, match="a continuous vector or one of n discrete ones"):
        train(replace(SMALL, env=f"sliding:{name}-v0", out=tmp_path), progress=False)


def test_discrete_actions_are_learnt(tmp_path):
    """To push to the right earns more in every state, and costs."""
    config = replace(SMALL, env="sliding:SlideDiscrete-v0", frames=2000, learning_rate=1e-2)
    free, limited = (
        main(replace(config, algorithm=algorithm, out=tmp_path / algorithm))
        for algorithm in ("ppo", "ppo-lagrangian")
    )
    policy = load_policy(tmp_path / "ppo" / "policy.pt")
    assert policy(np.array([1000.0, 0.0])).tolist() == [0, 0, 1]
    name = "evaluation_with_noise"
    assert limited[name]["cost/cost"][0] < free[name]["cost/cost"][0] / 2


# PyTorch's compiler uses what PyTorch and TorchRL have deprecated.
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
@pytest.mark.filterwarnings("ignore::FutureWarning")
@pytest.mark.slow
def test_compiled_is_the_same(tmp_path, monkeypatch):
    monkeypatch.setattr(compiling, "PAYS_FROM", 0)
    agents = [
        train(replace(SMALL, compile=compiled, out=tmp_path / str(compiled)), progress=False)[0]
        for compiled in (False, True)
    ]
    for (name, value), compiled in zip(
        agents[0].actor.named_parameters(), agents[1].actor.parameters(), strict=True
    ):
        torch.testing.assert_close(compiled, value, rtol=1e-3, atol=1e-4, msg=name)


def test_the_grid_against_omnisafe(monkeypatch):
    config = safe_gym_grid.Config()
    jobs = safe_gym_grid.jobs(config)
    assert len({job.out for (job,) in jobs.values()}) == len(jobs) == 2 * 2 * 3
    history = [
        {"frames": 50_000 * batch, "return": float(batch), "cost": 2.0 * batch}
        for batch in range(1, 11)
    ]
    for name in ("train_ours", "train_omnisafe"):
        monkeypatch.setattr(safe_gym_grid, name, lambda job: history)
    monkeypatch.setattr(safe_gym_grid, "process_time", itertools.count(0, 90).__next__)
    runs = [safe_gym_grid.run(*job) for job in jobs.values()]
    # Of the last tenth: the tenth batch alone.
    assert [run["return"] for run in runs] == [10.0] * 12
    row = "| SafetySwimmerVelocity-v1 | omnisafe | 10.0, 10.0, 10.0 | 20.0, 20.0, 20.0 | 1.5 |"
    assert row in safe_gym_grid.table(runs, config)
