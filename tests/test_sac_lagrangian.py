"""SACLagrangianLoss: what it does not share with TD3LagrangianLoss. See test_off_policy.py."""

import pytest
import torch
from off_policy import (
    call,
    make_actor,
    make_cost_critic,
    make_loss,
    parameters,
)
from tensordict.nn import (
    CompositeDistribution,
    NormalParamExtractor,
    TensorDictModule,
    set_composite_lp_aggregate,
)
from torch import nn
from torchrl.data import Bounded
from torchrl.modules import ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.objectives import SACLoss, SoftUpdate

from torchrl_safe.objectives import SACLagrangianLoss
from torchrl_safe.testing import OBSERVATION_SIZE, make_q_critic, make_transitions


def test_a_state_value_is_refused():
    value = ValueOperator(nn.Linear(OBSERVATION_SIZE, 1), in_keys=["observation"])
    networks = make_actor(SACLagrangianLoss), make_q_critic(), make_cost_critic()
    with pytest.raises(TypeError, match="value_network is not supported"):
        SACLagrangianLoss(*networks, value_network=value)


def test_the_entropy_is_divided_along_with_the_reward():
    """If entropy is all that actions earn, their gradient is 1 / (1 + lambda) of SAC's."""
    losses, gradients = [], []
    for multiplier in (0.0, 3.0):
        loss = make_loss(SACLagrangianLoss, multiplier_init=multiplier, alpha_init=0.5)
        for network in ("qvalue", "cost_qvalue"):
            for parameter in parameters(loss, network):
                parameter.data.zero_()
        losses.append(call(loss, make_transitions()))
        losses[-1]["loss_actor"].backward()
        gradients.append(torch.cat([p.grad.flatten() for p in parameters(loss, "actor")]))
    torch.testing.assert_close(losses[1]["loss_actor"], losses[0]["loss_actor"] / 4)
    torch.testing.assert_close(gradients[1], gradients[0] / 4)
    assert gradients[0].norm() > 1e-3
    # The temperature's own loss is about the entropy alone.
    assert torch.equal(losses[1]["loss_alpha"], losses[0]["loss_alpha"])


def test_target_entropy_from_the_action_spec():
    networks = make_actor(SACLagrangianLoss), make_q_critic(), make_cost_critic()
    loss = SACLagrangianLoss(*networks, action_spec=Bounded(-1, 1, (2,)))
    SoftUpdate(loss, tau=0.5)
    assert loss.target_entropy.item() == -2.0
    assert loss(make_transitions())["loss_cost_qvalue"] > 0


@pytest.mark.parametrize(("mode", "shown"), [("non_tensor", True), ("exclude", False)])
def test_multipliers_without_reduction(mode, shown):
    loss = make_loss(
        SACLagrangianLoss, 2, multiplier_init=0.5, reduction="none", scalar_output_mode=mode
    )
    losses = loss(make_transitions(2))
    assert losses.batch_size == (12,)
    assert losses["loss_cost_qvalue"].shape == (12,)
    names = {f"lagrange_multiplier_{index}" for index in range(2)}
    assert names & set(losses.keys()) == (names if shown else set())
    if shown:
        assert losses["lagrange_multiplier_1"] == 0.5


def test_done_states_can_be_skipped():
    """In a batch of any shape. test_off_policy.py has what the costs' targets are then."""
    loss = make_loss(SACLagrangianLoss, 2, skip_done_states=True)
    flat = make_transitions(2)
    batch = flat.reshape(3, 4)
    ours, expected = (call(loss, data)["loss_cost_qvalue"] for data in (batch, flat))
    torch.testing.assert_close(ours, expected)
    # As TorchRL's SACLoss, which takes a batch without the flag.
    del batch["next", "done"]
    assert loss(batch)["loss_cost_qvalue"].isfinite()


@pytest.fixture
def aggregation():
    """Composite log-probabilities are summed for the length of a test."""
    with set_composite_lp_aggregate(True):
        yield


@pytest.mark.usefixtures("aggregation")
def test_composite_actions():
    """An action in two parts: with SACLoss at multiplier zero, against it above."""

    class Heads(nn.Linear):
        def forward(self, observation):
            loc, scale = NormalParamExtractor()(super().forward(observation))
            return loc[..., :1], scale[..., :1], loc[..., 1:], scale[..., 1:]

    class Critic(nn.Linear):
        def forward(self, observation, arm, gripper):
            return super().forward(torch.cat([observation, arm, gripper], -1).square())

    def make(kind, *added, **options):
        torch.manual_seed(0)
        keys = [("params", part, name) for part in ("arm", "gripper") for name in ("loc", "scale")]
        actor = ProbabilisticActor(
            TensorDictModule(Heads(OBSERVATION_SIZE, 4), ["observation"], keys),
            in_keys=["params"],
            out_keys=["arm", "gripper"],
            distribution_class=CompositeDistribution,
            distribution_kwargs={"distribution_map": {"arm": TanhNormal, "gripper": TanhNormal}},
            return_log_prob=True,
        )
        inputs = ["observation", ("action", "arm"), ("action", "gripper")]
        critics = [
            ValueOperator(Critic(OBSERVATION_SIZE + 2, 1), in_keys=inputs, out_keys=[key])
            for key in ("state_action_value", *added)
        ]
        loss = kind(actor, *critics, target_entropy=-2.0, num_qvalue_nets=2, **options)
        loss.set_keys(action="action")
        SoftUpdate(loss, tau=0.5)
        return loss

    loss, parent = make(SACLagrangianLoss, "state_action_cost_value"), make(SACLoss)
    for network in ("actor", "qvalue"):
        pairs = zip(parameters(loss, network), parameters(parent, network), strict=True)
        for ours, theirs in pairs:
            ours.data.copy_(theirs.data)
    SoftUpdate(loss, tau=0.5)
    batch = make_transitions()
    arm, gripper = batch.pop("action").split(1, -1)
    batch["action"] = {"arm": arm, "gripper": gripper}
    expected, losses = call(parent, batch.clone()), call(loss, batch.clone())
    for key, value in expected.items():
        assert torch.equal(losses[key], value), key
    assert losses["loss_cost_qvalue"] > 0
    loss.lagrange_multiplier.fill_(2.0)
    assert call(loss, batch.clone())["loss_actor"] != losses["loss_actor"]
    assert ("next", "action", "arm") not in loss.in_keys
