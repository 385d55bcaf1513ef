"""CostTD0: one-step targets of several costs, by hand and against TorchRL's TD0Estimator."""

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, ReplayBuffer
from torchrl.envs import MultiStepTransform
from torchrl.objectives.value import TD0Estimator

from torchrl_safe.objectives import CostTD0


def make_batch(num_costs=3):
    """A running, a terminated and a truncated transition."""
    columns = torch.arange(1.0, num_costs + 1)
    return TensorDict(
        next=TensorDict(
            cost=columns.expand(3, num_costs).clone(),
            state_action_cost_value=10 * columns.expand(3, num_costs).clone(),
            done=torch.tensor([[False], [True], [True]]),
            terminated=torch.tensor([[False], [True], [False]]),
            batch_size=[3],
        ),
        batch_size=[3],
    )


def test_only_a_terminated_episode_is_worth_nothing_further():
    target = CostTD0(gamma=0.5).value_estimate(make_batch())
    expected = [[6.0, 12.0, 18.0], [1.0, 2.0, 3.0], [6.0, 12.0, 18.0]]
    assert torch.equal(target, torch.tensor(expected))


def test_each_column_is_that_of_td0():
    batch = make_batch()
    target = CostTD0(gamma=0.9).value_estimate(batch)
    for column in range(3):
        single = batch.clone()
        for key in ("cost", "state_action_cost_value"):
            single["next", key] = batch["next", key][:, column : column + 1]
        estimator = TD0Estimator(gamma=0.9, value_network=None)
        estimator.set_keys(reward="cost", value="state_action_cost_value")
        assert torch.equal(target[:, column : column + 1], estimator.value_estimate(single))


def test_several_steps_discount_by_their_number():
    batch = make_batch()
    batch["steps_to_next_obs"] = torch.tensor([[1], [1], [3]])
    target = CostTD0(gamma=0.5).value_estimate(batch)
    assert target[:, 0].tolist() == [6.0, 1.0, 1.0 + 10 / 8]


def test_behind_a_multi_step_transform():
    """Costs 1 and 2 in every step: three of them, discounted, and the value after the third."""
    steps = torch.zeros(1, 6, 1)
    batch = TensorDict(
        next=TensorDict(
            observation=steps,
            reward=steps,
            cost=torch.tensor([1.0, 2.0]).expand(1, 6, 2),
            done=steps.bool(),
            terminated=steps.bool(),
            batch_size=[1, 6],
        ),
        observation=steps,
        batch_size=[1, 6],
    )
    buffer = ReplayBuffer(
        storage=LazyTensorStorage(6),
        transform=MultiStepTransform(3, 0.5, reward_keys=["reward", "cost"]),
        batch_size=4,
        dim_extend=0,
    )
    for row in batch.unbind(0):
        buffer.extend(row.unsqueeze(0))
    sample = buffer.sample().reshape(-1)
    sample["next", "state_action_cost_value"] = torch.full((len(sample), 2), 8.0)
    target = CostTD0(gamma=0.5).value_estimate(sample)
    assert torch.equal(target, torch.tensor([1.75 + 1, 3.5 + 1]).expand(len(sample), 2))


def test_a_given_next_value_goes_first():
    next_value = torch.full((3, 3), 2.0)
    target = CostTD0(gamma=0.5).value_estimate(make_batch(), next_value=next_value)
    assert target[:, 0].tolist() == [2.0, 1.0, 2.0]


def test_the_batch_stays_as_it_is():
    batch = make_batch()
    CostTD0(gamma=0.5).value_estimate(batch)
    assert (batch == make_batch()).all()
    assert batch["next", "done"].shape == (3, 1)


def test_keys_can_be_nested():
    batch = make_batch()
    keys = {"reward": "cost", "value": "state_action_cost_value", "terminated": "terminated"}
    for name in keys.values():
        batch["next"].rename_key_(name, ("info", name))
    estimator = CostTD0(gamma=0.5)
    estimator.set_keys(**{key: ("info", name) for key, name in keys.items()})
    expected = CostTD0(gamma=0.5).value_estimate(make_batch())
    assert torch.equal(estimator.value_estimate(batch), expected)


def test_widths_must_agree():
    batch = make_batch()
    batch["next", "cost"] = torch.zeros(3, 2)
    with pytest.raises(ValueError, match=r"'cost' and its value .* shapes \(3, 2\) and \(3, 3\)"):
        CostTD0(gamma=0.5).value_estimate(batch)


@pytest.mark.parametrize("name", ["average_rewards", "group_key"])
def test_costs_keep_their_unit(name):
    with pytest.raises(ValueError, match=f"{name} is not supported by CostTD0"):
        CostTD0(gamma=0.9, **{name: True})


def test_several_steps_in_rows_of_one():
    batch = make_batch()
    batch["steps_to_next_obs"] = torch.tensor([1, 1, 3])
    expected = CostTD0(gamma=0.5).value_estimate(batch)
    rows = CostTD0(gamma=0.5).value_estimate(batch.reshape(3, 1))
    assert torch.equal(rows, expected.reshape(3, 1, 3))
