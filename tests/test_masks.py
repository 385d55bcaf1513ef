"""Steps that a mask leaves out, and the padding of trajectories: they count nowhere."""

import pytest
import torch
from on_policy import TRAINS, estimated, make_loss
from torchrl.collectors.utils import split_trajectories

from torchrl_safe.objectives import PPOLagrangianLoss
from torchrl_safe.testing import make_batch, make_networks


def mask_from(batch, first):
    """A mask that leaves out what follows in the first row, from a step on."""
    mask = torch.ones(*batch.shape, 1, dtype=torch.bool)
    mask[0, first:] = False
    return mask


def test_masked_steps_do_not_count():
    loss = make_loss(2, multiplier_init=1.0)
    data = estimated(loss, 2)
    kept = torch.arange(len(data)) % 3 != 0
    expected = loss(data[kept])
    data["collector", "mask"] = kept.unsqueeze(-1)
    data["cost_value_target"][~kept] = 1e6
    losses = loss(data)
    for key in TRAINS:
        torch.testing.assert_close(losses[key], expected[key])


@pytest.mark.parametrize("key", [("collector", "mask"), "mine"], ids=str)
def test_advantages_are_those_of_the_steps_that_count(key):
    """A padded row gives the others what they have without it, up to the rounding of sums."""
    loss = make_loss(2)
    if key == "mine":
        loss.loss_mask_key = key
    batch = make_batch(2)
    expected = loss.estimate_advantages(batch[1:].clone())
    batch[0] = batch[0].apply(torch.zeros_like)
    batch[key] = mask_from(batch, 0)
    padded = loss.estimate_advantages(batch)
    for name in ("cost_advantage", "cost_value_target", "value_target"):
        torch.testing.assert_close(padded[name][1:], expected[name])
    # Standardized, by the deviation that divides by the count.
    kept = padded["advantage"][1:]
    torch.testing.assert_close(kept.std(correction=0), torch.tensor(1.0))
    ratio = (kept.numel() / (kept.numel() - 1)) ** 0.5
    torch.testing.assert_close(kept, expected["advantage"] * ratio)
    assert "shifted_valid" not in padded


@pytest.mark.parametrize("terminated", [True, False])
@pytest.mark.parametrize("time_dim", [None, 0])
def test_what_pads_a_trajectory_changes_no_target(time_dim, terminated):
    """Not even where the end of the batch cut it, so that it is not done."""
    batch = make_batch(2)
    done = batch["next", "done"].squeeze(-1)
    before = torch.nn.functional.pad(done[:, :-1], (1, 0))
    rows = torch.arange(len(batch))[:, None] * batch.shape[1]
    batch["collector", "traj_ids"] = before.long().cumsum(1) + rows

    def loss():
        torch.manual_seed(0)
        loss = PPOLagrangianLoss(*make_networks(2), num_costs=2)
        loss.make_value_estimator(time_dim=time_dim)
        return loss.make_cost_value_estimator(time_dim=time_dim)

    if not terminated:  # Then estimators take done for it.
        del batch["next", "terminated"]
    split = split_trajectories(batch.clone(), trajectory_key=("collector", "traj_ids"))
    assert split["next", "done"].any(1).logical_not().any()  # Some are cut.
    ends = split["next", "done"].clone()
    if time_dim == 0:
        whole = loss().estimate_advantages(batch.transpose(0, 1).contiguous()).transpose(0, 1)
        split = loss().estimate_advantages(split.transpose(0, 1).contiguous()).transpose(0, 1)
    else:
        whole, split = (loss().estimate_advantages(data) for data in (batch, split))
    assert torch.equal(split["next", "done"], ends)
    assert (("next", "terminated") in split.keys(True)) is terminated
    counts = split["collector", "mask"]

    def in_order(data, key):
        return data[key][data["observation"][:, 0].argsort()]

    for key in ("value_target", "cost_value_target"):
        one, other = in_order(whole.reshape(-1), key), in_order(split[counts], key)
        torch.testing.assert_close(one, other)


def test_a_mask_must_be_bool():
    batch = make_batch()
    batch["collector", "mask"] = torch.ones(*batch.shape, 1)
    message = r"mask \('collector', 'mask'\) must be bool, got torch\.float32"
    with pytest.raises(ValueError, match=message):
        make_loss().estimate_advantages(batch)


@pytest.mark.parametrize(("key", "first"), [(("collector", "mask"), 4), ("mine", 0)])
def test_what_does_not_count_may_be_nan(key, first):
    """Its losses are 0, and 0 times NaN would be NaN in the gradients."""

    def make():
        loss = make_loss(2, multiplier_init=1.0)
        if key == "mine":
            loss.loss_mask_key = key
        return loss

    loss, batch = make(), make_batch(2)
    batch[key] = mask_from(batch, first)
    expected = make().estimate_advantages(batch.clone())
    batch["next", "reward"][0, first:] = batch["next", "cost"][0, first:] = torch.nan
    data = loss.estimate_advantages(batch)
    for name in ("advantage", "value_target", "cost_advantage", "cost_value_target"):
        torch.testing.assert_close(data[name], expected[name])
    assert data["next", "reward"][0, first:].isnan().all()  # The batch keeps its own.
    losses = loss(data.reshape(-1))
    sum(losses[key] for key in TRAINS).backward()
    gradients = [p.grad for p in loss.parameters() if p.grad is not None]
    assert gradients
    assert all(gradient.isfinite().all() for gradient in gradients)


def test_a_minibatch_of_padding_alone_teaches_nothing():
    loss = make_loss(2)
    data = estimated(loss, 2)
    data["collector", "mask"] = torch.zeros(len(data), 1, dtype=torch.bool)
    assert loss(data)["loss_cost_critic"] == 0


def test_a_loss_without_masks_takes_padding_for_steps():
    loss, batch = make_loss(2), make_batch(2)
    loss.loss_mask_key = None
    expected = loss.estimate_advantages(batch.clone())
    batch["collector", "mask"] = mask_from(batch, 4)
    actual = loss.estimate_advantages(batch)
    for key in ("value_target", "cost_value_target"):
        assert torch.equal(actual[key], expected[key])
