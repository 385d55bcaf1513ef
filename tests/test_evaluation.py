"""The figures that are reported: from episodes to the cells of the table."""

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl._utils import seed_generator
from torchrl.envs import RewardSum, TransformedEnv
from torchrl.envs.utils import ExplorationType, exploration_type
from torchrl.objectives import LossModule

from experiments.evaluation import evaluate, summarize
from experiments.log import figures
from experiments.report import table
from torchrl_safe.envs import ArmEnv, NoObstacles


def one(state):
    return np.ones(len(state.goal))


def fly_left(observation):
    """To goals on the left, straight; where the goal is on the right, nowhere."""
    to_goal = observation[:, 20:23]
    return (to_goal / 0.05).clamp(-1, 1) * (to_goal[:, 1:2] > -0.01)


def policy(tensordict):
    """Does the contrary while it explores."""
    sign = 1 if exploration_type() is ExplorationType.DETERMINISTIC else -1
    return tensordict.set("action", sign * fly_left(tensordict["observation"]))


def test_evaluation_plays_the_first_episode_of_each_seed(make_env):
    """Against episodes played by hand, one world and one seed at a time."""
    settings = {"obstacles": NoObstacles(), "costs": {"one": one}, "max_episode_steps": 60}
    sums = RewardSum(["reward", "cost"], ["episode_reward", "episode_cost"])
    env = make_env(lambda: TransformedEnv(ArmEnv(num_envs=3, **settings), sums))
    assert env.observation_fields["to_goal"] == slice(20, 23)
    episodes = evaluate(env, policy, 5, seed=4)
    assert episodes.shape == (6,), "whole rounds, at least as many as asked for"

    single = make_env(ArmEnv, **settings)
    seed = 4
    for row in episodes:
        single.set_seed(seed)
        seed = seed_generator(seed)
        tensordict, total, steps, done = single.reset(), 0, 0, False
        while not done:
            action = fly_left(tensordict["observation"])
            tensordict = single.step(tensordict.set("action", action))["next"]
            total, steps = total + tensordict["reward"].item(), steps + 1
            done = tensordict["done"].item()
        assert row["success"].item() == tensordict["success"].item()
        assert row["steps"].item() == row["episode_cost"].item() == steps
        assert row["episode_reward"].item() == pytest.approx(total, rel=1e-5)
    # Both kinds of end occur, and those that arrive have time for a second episode.
    assert 0 < episodes["success"].sum() < 6
    assert episodes["steps"][episodes["success"]].max() < 30


def test_summary_of_hand_made_episodes():
    costs = torch.tensor([[0.0, 3.0], [0.0, 1.0], [2.0, 0.0], [0.0, 4.0]])
    episodes = TensorDict(
        {
            "success": torch.tensor([[True], [True], [True], [False]]),
            "episode_reward": torch.tensor([[-1.0], [-2.0], [-3.0], [-6.0]]),
            "episode_cost": costs,
            "steps": torch.tensor([[10], [20], [30], [40]]),
        },
        batch_size=[4],
    )
    summary = summarize(episodes, ("first", "second"))
    assert {name: figure[0] for name, figure in summary.items()} == {
        "success": 0.75, "return": -3, "steps": 25,
        "cost/first": 0.5, "any/first": 0.25, "cost/second": 2, "any/second": 0.75,
    }  # fmt: skip
    for estimate, low, high in summary.values():
        assert low < estimate < high


def test_figures_of_a_batch():
    episodes = TensorDict(
        {
            "success": torch.tensor([[True], [True], [True], [False]]),
            "episode_reward": torch.tensor([[-1.0], [-2.0], [-3.0], [-6.0]]),
            "episode_cost": torch.tensor([[0.0], [2.0], [0.0], [0.0]]),
        },
        batch_size=[4],
    )
    loss = LossModule()
    loss.register_buffer("lagrange_multiplier", torch.tensor([0.5]))
    multiplier = {"multiplier/collision": 0.5}
    expected = {"return": -3, "cost/collision": 0.5, "success": 0.75, **multiplier}
    assert figures(episodes, loss, ("collision",)) == expected
    # No episode ended: no mean of nothing, which would be NaN.
    assert figures(episodes[:0], loss, ("collision",)) == multiplier
    assert figures(episodes[:0], LossModule(), ()) == {}, "not every algorithm has multipliers"


def test_table_of_hand_made_results():
    """Shares in percent, means as they are; each under its own heading."""
    row = {"success": [0.5, 0.25, 0.75], "cost/hit": [2, 1, 3], "any/hit": [0.125, 0.0, 0.25]}
    results = {
        "config": {"cost_limit": 0.5},
        "algorithms": {
            "ppo": {"evaluation": row},
            "other": {"evaluation": {**row, "cost/hit": [0.5, 0.25, 0.75]}},
        },
    }
    assert table(results).splitlines() == [
        "| evaluation | success | episode cost: hit | episodes with hit |",
        "|---|---|---|---|",
        "| ppo | 50.0% [25.0%, 75.0%] | 2.00 [1.00, 3.00] | 12.5% [0.0%, 25.0%] |",
        "| other | 50.0% [25.0%, 75.0%] | 0.50 [0.25, 0.75] | 12.5% [0.0%, 25.0%] |",
        "",
        "Cost limit 0.5; brackets: 95 % confidence.",
    ]
