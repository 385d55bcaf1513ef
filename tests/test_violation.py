"""ViolationUpdater: the front door for losses that read how far costs are from their limits."""

import re

import pytest
import torch
from on_policy import make_loss
from torchrl.objectives import LossModule

from torchrl_safe.objectives import DualAscent, IPOLoss, P3OLoss, PIDControl, ViolationUpdater
from torchrl_safe.testing import make_batch, make_networks

BY_MULTIPLIER = r"PPOLagrangianLoss has no cost_violation buffer\. Use PIDControl or DualAscent\.$"
BY_VIOLATION = r"P3OLoss has no lagrange_multiplier buffer\. Use ViolationUpdater\.$"


def make(num_costs=2, cost_limit=1.0, kind=P3OLoss):
    loss = kind(*make_networks(num_costs), num_costs=num_costs)
    return loss, ViolationUpdater(loss, cost_limit=cost_limit)


@pytest.mark.parametrize("limit", [1.5, torch.tensor(1.5), torch.tensor([1.5, 4.0])], ids=str)
def test_it_writes_mean_cost_minus_limit_in_place(limit):
    loss, updater = make(cost_limit=limit)
    assert loss.cost_violation.tolist() == [0.0, 0.0]
    address = loss.cost_violation.data_ptr()
    updater.step(torch.tensor([[2.0, 0.0], [4.0, 1.0]]))
    second = 4.0 if torch.as_tensor(limit).ndim else 1.5
    assert loss.cost_violation.tolist() == [1.5, 0.5 - second]
    assert loss.cost_violation.data_ptr() == address
    updater.step(torch.tensor([[1.5, second]]))
    assert loss.cost_violation.tolist() == [0.0, 0.0]


def test_limits_go_by_name():
    loss = P3OLoss(*make_networks(2), num_costs=2)
    limits = {"speed": 4.0, "touch": 1.5}
    updater = ViolationUpdater(loss, cost_limit=limits, cost_names=("touch", "speed"))
    updater.step(torch.tensor([[2.0, 3.0]]))
    assert loss.cost_violation.tolist() == [0.5, -1.0]
    with pytest.raises(ValueError, match=r"missing \['speed'\], unknown \['velocity'\]"):
        ViolationUpdater(
            loss, cost_limit={"touch": 1, "velocity": 2}, cost_names=updater.cost_names
        )


def test_pessimism_adds_standard_errors():
    loss, _ = make()
    updater = ViolationUpdater(loss, cost_limit=1.0, pessimism=2.0)
    updater.step(torch.tensor([[2.0, 0.0], [4.0, 0.0]]))
    torch.testing.assert_close(loss.cost_violation, torch.tensor([2.0 + 2.0 * 1.0, -1.0]))
    updater.step(torch.tensor([[2.0, 0.0]]))  # One episode has no standard error.
    assert loss.cost_violation.tolist() == [1.0, -1.0]
    with pytest.raises(ValueError, match=r"pessimism must be a number from 0 to .*, got -1"):
        ViolationUpdater(loss, cost_limit=1.0, pessimism=-1.0)
    with pytest.raises(ValueError, match=r"pessimism must be a number from 0 to .*, got -1"):
        updater.pessimism = -1.0


def test_without_an_episode_nothing_changes():
    loss, updater = make()
    updater.step(torch.tensor([[3.0, 0.0]]))
    updater.step(torch.zeros(0, 2))
    assert loss.cost_violation.tolist() == [2.0, -1.0]


def test_the_violation_is_a_buffer_of_the_loss_and_reported():
    saved, updater = make()
    updater.step(torch.tensor([[3.0, 0.0]]))
    assert not any("violation" in name for name, _ in saved.named_parameters())
    loaded, _ = make()
    loaded.load_state_dict(saved.state_dict())
    losses = loaded(make_batch(2))
    loaded.cost_violation.fill_(9.0)
    assert losses["cost_violation_0"] == 2.0
    assert losses["cost_violation_1"] == -1.0


def test_a_violation_moves_the_penalty_of_the_next_call():
    for kind in (P3OLoss, IPOLoss):
        loss, updater = make(kind=kind)
        data = loss.estimate_advantages(make_batch(2)).reshape(-1)
        penalties = []
        for cost in (0.0, 50.0, 100.0):
            updater.step(torch.full((1, 2), cost))
            penalties.append(loss(data)["loss_penalty"].item())
        assert penalties == sorted(set(penalties))


def test_state_round_trip():
    _, updater = make(cost_limit=torch.tensor([1.0, 2.0]))
    loss, other = make(cost_limit=5.0)
    other.load_state_dict(updater.state_dict())
    other.step(torch.tensor([[1.0, 1.0]]))
    assert loss.cost_violation.tolist() == [0.0, -1.0]
    _, three = make(3)
    with pytest.raises(ValueError, match="2 cost limits, this updater 3"):
        three.load_state_dict(updater.state_dict())


@pytest.mark.parametrize("shape", [(1,), (3,), (2, 1)], ids=str)
def test_a_limit_of_the_wrong_length_is_refused(shape):
    with pytest.raises(ValueError, match=rf"cost_limit.* 2 costs.*{re.escape(str(shape))}"):
        make(cost_limit=torch.ones(shape))


def test_what_cannot_be_a_limit_or_a_loss_is_refused():
    with pytest.raises(ValueError, match="cost_limit must be finite, got nan"):
        make(cost_limit=float("nan"))
    with pytest.raises(ValueError, match=BY_MULTIPLIER):
        ViolationUpdater(make_loss(), cost_limit=1.0)
    with pytest.raises(ValueError, match=BY_VIOLATION):
        PIDControl(P3OLoss(*make_networks(), num_costs=1), cost_limit=1.0)
    with pytest.raises(ValueError, match=r"LossModule has no cost_violation buffer\.$"):
        ViolationUpdater(LossModule(), cost_limit=1.0)
    with pytest.raises(ValueError, match="must be a LossModule, got "):
        ViolationUpdater(torch.nn.Linear(1, 1), cost_limit=1.0)


@pytest.mark.parametrize(
    ("cost", "message"),
    [
        (torch.ones(3, 1), r"episode_cost must have shape \(E, 2\), .* got \(3, 1\)"),
        (torch.ones(2), r"episode_cost must have shape \(E, 2\), .* got \(2,\)"),
        (torch.tensor([[1.0, float("nan")]]), "episode_cost must be finite"),
        (torch.tensor([[2e38, 1.0], [2e38, 1.0]]), "episode_cost must have a mean"),
        (torch.tensor([[1e300, 1.0]], dtype=torch.float64), "episode_cost must have a mean"),
    ],
    ids=["width", "one-dimension", "nan", "sum-too-large", "too-large"],
)
def test_costs_that_cannot_be_used_change_nothing(cost, message):
    loss, updater = make()
    updater.step(torch.tensor([[3.0, 0.0]]))
    with pytest.raises(ValueError, match=message):
        updater.step(cost)
    assert loss.cost_violation.tolist() == [2.0, -1.0]


def test_a_state_of_another_kind_of_updater_is_refused():
    loss = LossModule()
    loss.register_buffer("cost_violation", torch.zeros(1))
    loss.register_buffer("lagrange_multiplier", torch.zeros(1))
    updaters = (
        ViolationUpdater(loss, cost_limit=1.0),
        DualAscent(loss, cost_limit=1.0, lr=0.1),
        PIDControl(loss, cost_limit=1.0, kp=1.0, ki=1.0, kd=1.0),
    )
    for one in updaters:
        for other in updaters:
            if other is not one:
                with pytest.raises(ValueError, match=f"The state of a {type(one).__name__} has"):
                    one.load_state_dict(other.state_dict())
