"""MultiplierHook on single batches: costs, multipliers and violations by hand."""

import pytest
import torch
from on_policy import make_loss
from tensordict import TensorDict
from torch import nn

from torchrl_safe.objectives import DualAscent, P3OLoss, ViolationUpdater
from torchrl_safe.testing import make_batch, make_networks
from torchrl_safe.trainers import MultiplierHook


def make_episodes(cost, done, key="episode_cost"):
    """A batch of what a hook reads: running sums of the costs, and where episodes end."""
    next_data = TensorDict({key: torch.tensor(cost)}, batch_size=[len(done)])
    next_data["done"] = torch.tensor(done).unsqueeze(-1)
    return TensorDict({"next": next_data}, batch_size=[len(done)])


def test_one_batch_by_hand():
    """Of three rows two ended, at mean costs (4, 1): 0.5 times (4 - 1, 1 - 2), not below 0."""
    loss = make_loss(num_costs=2, multiplier_init=0.25)
    hook = MultiplierHook(DualAscent(loss, cost_limit=torch.tensor([1.0, 2.0]), lr=0.5))
    batch = make_episodes([[3.0, 2.0], [9.0, 9.0], [5.0, 0.0]], [True, False, True])
    assert hook(batch) is batch
    assert loss.lagrange_multiplier.tolist() == [1.75, 0]
    assert hook.log(batch) == {
        "log_pbar": True,
        "lagrange_multiplier/0": 1.75,
        "lagrange_multiplier/1": 0,
        "episode_cost/0": 4,
        "episode_cost/1": 1,
    }


def test_a_batch_in_which_no_episode_ended():
    loss = make_loss(multiplier_init=0.25)
    hook = MultiplierHook(DualAscent(loss, cost_limit=1.0, lr=0.5, cost_names=["touch"]))
    batch = hook(make_episodes([[3.0], [4.0]], [False, False]))
    assert loss.lagrange_multiplier.item() == 0.25
    assert hook.log(batch) == {"log_pbar": True, "lagrange_multiplier/touch": 0.25}


def test_violations():
    loss = P3OLoss(*make_networks())
    hook = MultiplierHook(ViolationUpdater(loss, cost_limit=1.0, cost_names=["touch"]))
    scalars = hook.log(hook(make_episodes([[3.0], [4.0]], [True, True])))
    assert scalars["cost_violation/touch"] == 2.5


def test_nested_keys():
    loss = make_loss()
    hook = MultiplierHook(
        DualAscent(loss, cost_limit=1.0, lr=1.0),
        episode_cost_key=("arm", "total"),
        done_key=("arm", "done"),
    )
    done = torch.tensor([[[True], [False]], [[False], [True]]])
    batch = TensorDict(batch_size=[2])
    batch["next", "arm", "done"] = done
    batch["next", "arm", "total"] = torch.tensor([[[2.0], [9.0]], [[9.0], [4.0]]])
    hook(batch)
    assert loss.lagrange_multiplier.item() == 2


def test_padded_batches():
    """Trajectories of different length: what fills them up has not ended."""
    loss = make_loss()
    hook = MultiplierHook(DualAscent(loss, cost_limit=0.0, lr=1.0))
    batch = TensorDict(batch_size=[2, 3])
    batch["collector", "mask"] = torch.tensor([[True, True, True], [True, False, False]])
    batch["next", "done"] = torch.tensor([[False, False, True], [True, False, False]]).unsqueeze(-1)
    batch["next", "episode_cost"] = torch.tensor([[1.0, 2.0, 3.0], [5.0, 0.0, 0.0]]).unsqueeze(-1)
    hook(batch)
    assert loss.lagrange_multiplier.item() == 4


def test_names_are_those_of_the_updater():
    loss, limits = make_loss(num_costs=2), {"touch": 1.0, "speed": 2.0}
    updater = DualAscent(loss, cost_limit=limits, cost_names=["touch", "speed"], lr=0.5)
    assert set(MultiplierHook(updater).log(make_episodes([[3.0, 2.0]], [True]))) == {
        "log_pbar",
        "episode_cost/touch",
        "episode_cost/speed",
        "lagrange_multiplier/touch",
        "lagrange_multiplier/speed",
    }


def test_no_updater():
    with pytest.raises(TypeError, match=r"updater must be a MultiplierUpdater .* got SGD"):
        MultiplierHook(torch.optim.SGD([nn.Parameter(torch.ones(1))]))


@pytest.mark.parametrize(
    ("settings", "error", "message"),
    [
        ({}, KeyError, r"episode_cost_key .*'next.*'episode_cost.* is not .* append RewardSum"),
        ({"done_key": "end"}, KeyError, "done_key .'next', 'end'. is not in the batch"),
        (
            {"episode_cost_key": "observation", "done_key": "cost"},
            ValueError,
            r"done_key .* must be of shape \(4, 6, 1\) .* got \(4, 6, 2\)",
        ),
        (
            {"episode_cost_key": "observation"},
            ValueError,
            r"episode_cost must have shape \(E, 2\), .* got \(5, 4\)",
        ),
    ],
)
def test_a_batch_that_does_not_fit(settings, error, message):
    loss = make_loss(num_costs=2)
    hook = MultiplierHook(DualAscent(loss, cost_limit=1.0, lr=0.5), **settings)
    with pytest.raises(error, match=message):
        hook(make_batch(num_costs=2))
    assert loss.lagrange_multiplier.tolist() == [0, 0]
