"""The figures that are reported: from episodes to the cells of the table."""

from functools import partial

import gymnasium
import numpy as np
import pytest
import torch
from counting import flagged
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torchrl._utils import seed_generator
from torchrl.data import Composite, Unbounded
from torchrl.envs import (
    Compose,
    ExcludeTransform,
    GymWrapper,
    InitTracker,
    RenameTransform,
    RewardSum,
    SerialEnv,
    TransformedEnv,
    default_info_dict_reader,
)
from torchrl.envs.utils import ExplorationType, RandomPolicy, exploration_type
from torchrl.modules import LSTMModule
from torchrl.objectives import LossModule

from experiments.log import figures
from experiments.report import table
from torchrl_safe.envs import ArmEnv, CostToReward, NoObstacles
from torchrl_safe.evaluation import evaluate, summarize


def one(state):
    return np.ones(len(state.goal))


def fly_left(observation):
    """To goals on the left, straight; where the goal is on the right, nowhere."""
    to_goal = observation[..., 20:23]
    return (to_goal / 0.05).clamp(-1, 1) * (to_goal[..., 1:2] > -0.01)


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


def test_with_exploration_the_policy_explores(make_env):
    env = make_env(ArmEnv, num_envs=2, max_episode_steps=20)
    episodes = evaluate(env, policy, 2, seed=4, exploration_type=ExplorationType.RANDOM)
    contrary = evaluate(env, lambda td: td.set("action", -fly_left(td["observation"])), 2, seed=4)
    assert torch.equal(episodes["episode_reward"], contrary["episode_reward"])
    assert not torch.equal(
        episodes["episode_reward"], evaluate(env, policy, 2, seed=4)["episode_reward"]
    )
    with pytest.raises(TypeError, match="exploration_type must be an instance of"):
        evaluate(env, policy, 2, seed=4, exploration_type="random")


def test_the_sums_are_those_of_reward_sum(make_env):
    """Without the transform, in one process and in batches of batches."""
    settings = {"num_envs": 2, "obstacles": NoObstacles(), "costs": {"one": one, "two": one}}
    sums = RewardSum(["reward", "cost"], ["episode_reward", "episode_cost"])
    expected = evaluate(
        make_env(lambda: TransformedEnv(ArmEnv(**settings), sums)), policy, 4, seed=4
    )
    env = make_env(ArmEnv, **settings)
    episodes = evaluate(env, policy, 4, seed=4)
    torch.testing.assert_close(episodes, expected)
    assert episodes["episode_cost"].shape == (4, 2)
    assert "episode_reward" not in env.rollout(1)["next"], "the environment is as it was"
    batched = make_env(lambda: SerialEnv(2, partial(ArmEnv, **settings)))
    assert evaluate(batched, policy, 5, seed=4).shape == (8,)


class Counting(gymnasium.Env):
    """Ends after as many steps as the seed says; the first of two observations is the cost."""

    observation_space = gymnasium.spaces.Box(0, 9, (2,), np.float32)
    action_space = gymnasium.spaces.Box(-1, 1, (1,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps, self.length = 0, self.np_random.integers(1, 6)
        return np.zeros(2, np.float32), {}

    def step(self, action):
        self.steps += 1
        return np.ones(2, np.float32), 0.5, self.steps >= self.length, False, {}


def counting(*transforms):
    cost = RenameTransform(["observation"], ["cost"], create_copy=True)
    return TransformedEnv(GymWrapper(Counting()), Compose(cost, CostToReward(), *transforms))


def keep_still(observation):
    assert not torch.is_grad_enabled()
    return observation[..., :1]


STILL = TensorDictModule(keep_still, ["observation"], ["action"])


def test_any_environment_with_a_cost():
    env, plain = counting(), GymWrapper(Counting())
    episodes = evaluate(env, STILL, 20, seed=0)
    assert set(episodes.keys()) == {"episode_reward", "episode_cost", "steps"}
    assert set(episodes["steps"].squeeze(-1).tolist()) == {1, 2, 3, 4, 5}
    torch.testing.assert_close(episodes["episode_reward"], 0.5 * episodes["steps"])
    torch.testing.assert_close(episodes["episode_cost"], episodes["steps"].float().expand(20, 2))
    assert list(summarize(episodes)) == [
        "return", "steps", "cost/0", "any/0", "cost/1", "any/1"
    ]  # fmt: skip
    with pytest.raises(ValueError, match="max_steps must let every episode end, got 4, "):
        evaluate(env, STILL, 20, seed=0, max_steps=4)
    with pytest.raises(ValueError, match="env must have the key 'cost' or 'episode_cost', got"):
        evaluate(plain, STILL, 1, seed=0)
    reader = default_info_dict_reader(["cost"], spec=Composite(cost=Unbounded(())))
    told = GymWrapper(Counting()).set_info_dict_reader(reader)
    with pytest.raises(ValueError, match=r"cost must have shape \(\*\(\), k\), got \(\)"):
        evaluate(told, STILL, 1, seed=0)
    with pytest.raises(ValueError, match="episodes must be a whole number of at least 1, got 0"):
        evaluate(env, STILL, 0, seed=0)
    with pytest.raises(ValueError, match="cost_names must be a different name for each"):
        summarize(episodes, ("one",))


def test_an_episode_may_end_with_the_last_of_max_steps():
    assert evaluate(counting(), STILL, 20, seed=0, max_steps=5)["steps"].max() == 5


def test_flags_are_counted():
    assert evaluate(flagged(), STILL, 2, seed=0)["episode_cost"].tolist() == [[4.0], [4.0]]
    summed = flagged(RewardSum(["cost"], ["episode_cost"]))
    with pytest.raises(ValueError, match=r"episode_cost must be numbers, got torch.bool: make the"):
        evaluate(summed, STILL, 2, seed=0)


def test_the_sums_are_enough():
    sums = RewardSum(["reward", "cost"], ["episode_reward", "episode_cost"])
    episodes = evaluate(counting(sums, ExcludeTransform("cost")), STILL, 20, seed=0)
    torch.testing.assert_close(episodes["episode_cost"], episodes["steps"].float().expand(20, 2))


def test_done_flags_in_a_group_are_refused():
    """Of several agents, which of them end an episode?"""
    env = counting(RenameTransform(["done"], [("agent", "done")]))
    with pytest.raises(ValueError, match="env must have the key 'done', got "):
        evaluate(env, STILL, 2, seed=0)


def test_a_recurrent_policy_needs_its_primer():
    """Without one, TorchRL would drop its state after each step."""
    lstm = LSTMModule(input_size=2, hidden_size=3, in_key="observation", out_key="hidden")
    actor = TensorDictSequential(lstm, TensorDictModule(nn.Linear(3, 1), ["hidden"], ["action"]))
    evaluate(counting(InitTracker(), lstm.make_tensordict_primer()), actor, 2, seed=0)
    with pytest.raises(ValueError, match=r"env must have the keys .*recurrent_state_h"):
        evaluate(counting(InitTracker()), actor, 2, seed=0)


def test_an_environment_comes_first(make_env):
    env = make_env(ArmEnv)
    policy = RandomPolicy(env.action_spec)
    with pytest.raises(TypeError, match=r"env must be an instance of EnvBase, got <.*RandomPolicy"):
        evaluate(policy, env, 1, seed=0)
    with pytest.raises(TypeError, match="policy must be callable, got None"):
        evaluate(env, None, 1, seed=0)


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
    with pytest.raises(ValueError, match=r"success must be True or False, got torch\.float32"):
        summarize(episodes.set("success", costs[:, :1]))


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
    """Shares are in percent, means unchanged, each under its own heading."""
    row = {"success": [0.5, 0.25, 0.75], "cost/hit": [2, 1, 3], "any/hit": [0.125, 0.0, 0.25]}
    results = {
        "cost_limits": {"hit": 0.5},
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


def test_a_module_plays_in_evaluation_mode_and_is_left_as_it_was(make_env):
    """Dropout would be another policy, and batch norm would learn from the evaluation."""
    env = make_env(ArmEnv, num_envs=2, max_episode_steps=3)
    net = torch.nn.Sequential(torch.nn.BatchNorm1d(40), torch.nn.Dropout(0.5))
    net.append(torch.nn.Linear(40, 3))
    actor = TensorDictModule(net, ["observation"], ["action"])
    net[1].eval()
    before = {name: value.clone() for name, value in actor.state_dict().items()}
    first, second = (evaluate(env, actor, 2, seed=0) for _ in range(2))
    assert torch.equal(first["episode_reward"], second["episode_reward"])
    assert all(torch.equal(before[name], value) for name, value in actor.state_dict().items())
    assert [module.training for module in net] == [True, False, True]
