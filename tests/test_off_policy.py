"""What SACLagrangianLoss and TD3LagrangianLoss share: nothing changes at multiplier zero, the
cost critics' targets, the mixed objective, targets and multipliers."""

import pytest
import torch
from off_policy import (
    OWN,
    PARENTS,
    TRAINS,
    assert_same_outputs,
    call,
    each_loss,
    make_actor,
    make_cost_critic,
    make_kind,
    make_loss,
    make_parent,
    networks_with_gradient,
    parameters,
)
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torch.nn.functional import smooth_l1_loss
from torchrl.data import Bounded
from torchrl.modules import ValueOperator
from torchrl.objectives import SoftUpdate

from torchrl_safe.objectives import (
    CostTD0,
    DualAscent,
    PIDControl,
    SACLagrangianLoss,
    TD3LagrangianLoss,
)
from torchrl_safe.testing import (
    check_equals_at_zero,
    make_q_critic,
    make_q_networks,
    make_transitions,
)

SHARED_OPTIONS = {
    "default": {},
    "reduction_sum": {"reduction": "sum"},
    "l2": {"loss_function": "l2"},
    "no_target_critics": {"delay_qvalue": False},
    "three_critics": {"num_qvalue_nets": 3},
    "separate_losses": {"separate_losses": True},
    "deactivate_vmap": {"deactivate_vmap": True},
}


OPTIONS = {
    SACLagrangianLoss: {
        "delay_actor": {"delay_actor": True},
        "fixed_alpha": {"fixed_alpha": True, "alpha_init": 0.3},
        "bounded_alpha": {"min_alpha": 0.1, "max_alpha": 0.5},
        "skip_done_states": {"skip_done_states": True},
        "none_non_tensor": {"reduction": "none", "scalar_output_mode": "non_tensor"},
        "none_exclude": {"reduction": "none", "scalar_output_mode": "exclude"},
    },
    TD3LagrangianLoss: {
        "no_target_actor": {"delay_actor": False},
        "strong_noise": {"policy_noise": 2.0, "noise_clip": 1.0},
        "none": {"reduction": "none"},
    },
}


CASES = [
    pytest.param(kind, options, id=f"{PARENTS[kind].__name__}-{name}")
    for kind, own in OPTIONS.items()
    for name, options in (SHARED_OPTIONS | own).items()
]


def trained_losses(loss):
    return [key for key in ("loss_alpha", *TRAINS) if key in loss.out_keys]


# ---------------------------------------------------------------- multiplier zero: the parent


@pytest.mark.parametrize("num_costs", [1, 3])
@pytest.mark.parametrize(("kind", "options"), CASES)
def test_multiplier_zero_is_the_parent_bit_for_bit(kind, options, num_costs):
    loss, parent = make_loss(kind, num_costs, **options), make_parent(kind, **options)
    ours, theirs = make_transitions(num_costs), make_transitions(num_costs)
    expected = call(parent, theirs)
    random_state = torch.get_rng_state()
    losses = call(loss, ours)
    assert torch.equal(torch.get_rng_state(), random_state)
    assert_same_outputs(losses, expected)
    # The priority is written into the batch, and nothing else (SACLoss leaves more behind).
    assert set(ours.keys(True)) == {*make_transitions().keys(True), "td_error"}
    assert torch.equal(ours["td_error"], theirs["td_error"])
    assert (ours.exclude("td_error") == make_transitions(num_costs)).all()
    assert expected["loss_actor"].abs().min() > 0
    extra = {"loss_cost_qvalue"}
    if options.get("scalar_output_mode") != "exclude":
        extra |= {f"lagrange_multiplier_{index}" for index in range(num_costs)}
    assert set(losses.keys()) == set(expected.keys()) | extra


@pytest.mark.parametrize(("kind", "options"), CASES)
def test_multiplier_zero_trains_like_the_parent_bit_for_bit(kind, options):
    """Also the gradients, the temperature, and the target networks."""
    make, make_parent, setting = make_kind(kind, **options)
    check_equals_at_zero(make, make_parent, **setting)


# ---------------------------------------------------------------- the cost critics' targets


def make_constant(loss, values, target_values):
    """Cost critics that predict the same everywhere: values of shape (N, k)."""
    with torch.no_grad():
        for target, wanted in ((False, values), (True, target_values)):
            prefix = "target_" if target else ""
            params = getattr(loss, f"{prefix}cost_qvalue_network_params")
            for key, parameter in params.items(True, True):
                parameter.data.zero_()
                if key[-2:] == ("2", "bias"):
                    parameter.data.copy_(wanted)
    return loss


@each_loss
def test_targets_by_hand(kind):
    """Terminated or truncated; the largest of the ensemble, for each cost by itself."""
    values = torch.tensor([[0.0, 1.0], [2.0, 3.0]])
    target_values = torch.tensor([[10.0, 0.0], [4.0, 6.0]])
    loss = make_constant(make_loss(kind, 2, loss_function="l2"), values, target_values)
    loss.make_cost_value_estimator(gamma=0.5)
    batch = make_transitions(2, num_transitions=3)  # Goes on, terminates, is truncated.
    batch["next", "cost"] = torch.tensor([[1.0, 2.0], [1.0, 2.0], [3.0, 0.0]])
    # 0.5 max(10, 4) = 5 and 0.5 max(0, 6) = 3 follow, except at the end.
    targets = torch.tensor([[6.0, 5.0], [1.0, 2.0], [8.0, 3.0]])
    expected = sum((targets - critic).pow(2).sum(-1) for critic in values).mean()
    losses = loss(batch)
    assert losses["loss_cost_qvalue"].item() == pytest.approx(expected.item())
    losses["loss_cost_qvalue"].backward()
    bias = loss.cost_qvalue_network_params["module", "body", "2", "bias"]
    by_hand = torch.stack([2 * (critic - targets).mean(0) for critic in values])
    torch.testing.assert_close(bias.grad, by_hand)


@each_loss
def test_critics_and_targets_settle_at_the_discounted_cost(kind):
    """The same transition again and again costs c / (1 - gamma); a terminated one, c."""
    loss = make_constant(
        make_loss(kind, 3, loss_function="l2"), torch.zeros(2, 3), torch.zeros(2, 3)
    ).make_cost_value_estimator(gamma=0.5)
    batch = make_transitions(3, num_transitions=1).expand(8).clone()
    batch["next", "observation"] = batch["observation"].clone()
    batch["next", "cost"] = torch.tensor([1.0, 2.0, 0.0]).expand(8, 3)
    bias = loss.cost_qvalue_network_params["module", "body", "2", "bias"]
    optimizer, targets = torch.optim.SGD([bias], lr=0.25), SoftUpdate(loss, tau=0.5)
    for terminated, expected in ((False, [2.0, 4.0, 0.0]), (True, [1.0, 2.0, 0.0])):
        batch["next", "terminated"] = torch.full((8, 1), terminated)
        batch["next", "done"] = torch.ones(8, 1, dtype=torch.bool)  # Else truncated.
        for _ in range(50):
            loss(batch)["loss_cost_qvalue"].backward()
            optimizer.step()
            optimizer.zero_grad()
            targets.step()
        torch.testing.assert_close(
            bias.detach(), torch.tensor(expected).expand(2, 3), atol=1e-3, rtol=0
        )


@pytest.mark.parametrize(
    ("kind", "options"),
    [
        (SACLagrangianLoss, {}),
        (SACLagrangianLoss, {"skip_done_states": True}),
        (TD3LagrangianLoss, {}),
    ],
    ids=["sac", "sac-skips-done-states", "td3"],
)
def test_next_costs_are_those_of_the_action_that_the_reward_is_bootstrapped_with(kind, options):
    """With costs and rewards alike, and critics alike, the two losses are alike too."""
    loss = make_loss(kind, 1, **NO_ENTROPY[kind], **options)
    with torch.no_grad():
        for target in (False, True):
            pairs = zip(
                parameters(loss, "cost_qvalue", target),
                parameters(loss, "qvalue", target),
                strict=True,
            )
            for cost, reward in pairs:  # One critic twice: the largest is the smallest.
                reward.data.copy_(reward.data[:1].expand_as(reward.data).clone())
                cost.data.copy_(reward.data)
    batch = make_transitions(1)
    batch["next", "cost"] = batch["next", "reward"].clone()
    losses = loss(batch)
    torch.testing.assert_close(losses["loss_cost_qvalue"], losses["loss_qvalue"])
    # The action is random, so an action drawn again would have shown.
    again = loss(batch)
    assert losses["loss_qvalue"] != again["loss_qvalue"]


NO_ENTROPY = {SACLagrangianLoss: {"fixed_alpha": True, "alpha_init": 1e-12}, TD3LagrangianLoss: {}}


@each_loss
def test_discount_of_the_costs_acts_on_the_costs_alone(kind):
    loss, batch = make_loss(kind, 2), make_transitions(2)
    before = call(loss, batch)
    assert loss.cost_value_estimator.gamma.item() == pytest.approx(0.99)
    loss.make_cost_value_estimator(gamma=0.5)
    after = call(loss, batch)
    changed = {key for key, value in before.items() if not torch.equal(value, after[key])}
    assert changed == {"loss_cost_qvalue"}
    loss.make_value_estimator(gamma=0.5)
    last = call(loss, batch)
    assert torch.equal(last["loss_cost_qvalue"], after["loss_cost_qvalue"])
    assert last["loss_qvalue"] != after["loss_qvalue"]


@each_loss
def test_an_estimator_can_be_passed(kind):
    loss = make_loss(kind, 2)
    loss.set_keys(cost="renamed")
    estimator = CostTD0(gamma=0.5)
    assert loss.make_cost_value_estimator(estimator) is loss
    assert loss.cost_value_estimator is estimator
    assert estimator.tensor_keys.reward == "renamed"
    with pytest.raises(ValueError, match="'gamma'"):
        loss.make_cost_value_estimator(estimator, gamma=0.9)
    with pytest.raises(TypeError, match=r"estimator must be a ValueEstimatorBase, got 0\.9"):
        loss.make_cost_value_estimator(0.9)


@each_loss
def test_the_loss_is_the_sum_over_ensemble_and_costs(kind):
    whole = make_loss(kind, 3, num_cost_qvalue_nets=2, reduction="sum", **NO_ENTROPY[kind])
    values = torch.tensor([[0.0, 1.0, 2.0], [2.0, 3.0, -1.0]])
    make_constant(whole, values, torch.zeros(2, 3))
    batch = make_transitions(3)
    cost = batch["next", "cost"]
    errors = [smooth_l1_loss(critic.expand_as(cost), cost, reduction="sum") for critic in values]
    torch.testing.assert_close(whole(batch)["loss_cost_qvalue"], sum(errors))


@each_loss
def test_weights_and_masks_act_on_the_cost_critics(kind):
    loss, batch = make_loss(kind, 2, **NO_ENTROPY[kind]), make_transitions(2)
    make_constant(loss, torch.ones(2, 2), torch.zeros(2, 2))
    error = 2 * smooth_l1_loss(torch.ones(12, 2), batch["next", "cost"], reduction="none").sum(-1)
    torch.testing.assert_close(loss(batch)["loss_cost_qvalue"], error.mean())
    weights = torch.arange(12.0)
    weighted = batch.clone().set("priority_weight", weights)
    expected = (error * weights).sum() / weights.sum()
    torch.testing.assert_close(loss(weighted)["loss_cost_qvalue"], expected)
    kept = torch.arange(12) % 3 != 0
    masked = batch.clone().set(("collector", "mask"), kept.unsqueeze(-1))
    torch.testing.assert_close(loss(masked)["loss_cost_qvalue"], error[kept].mean())


# ---------------------------------------------------------------- the mixed objective


@each_loss
def test_a_very_large_multiplier_minimizes_its_cost(kind):
    """Two critics that differ in their bias alone: the actor follows the larger prediction."""
    loss, batch = make_loss(kind, 3), make_transitions(3)
    loss.lagrange_multiplier[1] = 1e8
    call(loss, batch)["loss_actor"].backward()
    ours = torch.cat([p.grad.flatten() for p in parameters(loss, "actor")])

    twin = make_loss(kind, 3)
    torch.manual_seed(7)
    if kind is SACLagrangianLoss:
        twin._draw_action(batch["next"])  # The loss draws the next action first.
        acted = batch.clone().set("action", twin._draw_action(batch)[0])
    else:
        with twin.actor_network_params.to_module(twin.actor_network):
            acted = twin.actor_network(batch.clone())
    predictions = []
    for member in range(2):
        with twin.cost_qvalue_network_params[member].to_module(twin.cost_qvalue_network):
            predictions.append(twin.cost_qvalue_network(acted)["state_action_cost_value"][:, 1])
    torch.stack(predictions).amax(0).mean().backward()
    theirs = torch.cat([p.grad.flatten() for p in parameters(twin, "actor")])
    assert theirs.norm() > 1e-3
    torch.testing.assert_close(ours / ours.norm(), theirs / theirs.norm(), atol=1e-4, rtol=1e-3)


@each_loss
def test_the_objective_by_hand(kind):
    """Critics that predict constants shift the loss of the actor by what the formula says."""
    multiplier = torch.tensor([0.5, 2.0])
    loss = make_constant(
        make_loss(kind, 2, multiplier_init=multiplier),
        torch.tensor([[1.0, 0.0], [3.0, -4.0]]),
        torch.zeros(2, 2),
    )
    batch = make_transitions(2)
    without = call(make_parent(kind), batch)["loss_actor"]
    # The largest predictions are 3 and 0; the entropy of SAC is divided with the rest.
    expected = (without + 0.5 * 3 + 2.0 * 0) / (1 + 0.5 + 2.0)
    torch.testing.assert_close(call(loss, batch)["loss_actor"], expected)


@pytest.mark.parametrize("separate", [True, False], ids=["separate_losses", "joint"])
@each_loss
def test_separate_losses_freeze_what_the_cost_critics_share_with_the_actor(kind, separate):
    actor, critic = make_actor(kind), make_q_critic()
    shared = next(module for module in actor.modules() if isinstance(module, nn.Linear))
    encoder = TensorDictModule(shared, ["observation"], ["hidden"])
    head = nn.Linear(shared.out_features, 2)
    head = ValueOperator(head, in_keys=["hidden"], out_keys=["state_action_cost_value"])
    cost_critic = TensorDictSequential(encoder, head)
    loss = kind(actor, critic, cost_critic, num_costs=2, separate_losses=separate, **OWN[kind])
    SoftUpdate(loss, tau=0.5)
    params = loss.cost_qvalue_network_params["module"]
    assert params["0", "module", "weight"].requires_grad == (not separate)
    assert params["1", "module", "weight"].requires_grad
    # Frozen, the ensemble reads what the actor has; else each member has a layer of its own.
    assert torch.equal(params["0", "module", "weight"][0], shared.weight) == separate
    loss(make_transitions(2))["loss_cost_qvalue"].backward()
    assert params["1", "module", "weight"].grad.abs().sum() > 0
    assert all(p.grad is None for p in parameters(loss, "actor"))


# ---------------------------------------------------------------- targets and multipliers


@each_loss
def test_soft_update_moves_the_target_cost_critics(kind):
    loss = make_loss(kind, 2)
    before = [p.clone() for p in parameters(loss, "cost_qvalue", target=True)]
    updater = SoftUpdate(loss, tau=0.25)  # Starts from targets like their sources.
    sources = parameters(loss, "cost_qvalue")
    start = [p.detach().clone() for p in sources]
    assert all(map(torch.equal, start, parameters(loss, "cost_qvalue", target=True)))
    assert not any(map(torch.equal, before, start))
    with torch.no_grad():
        for p in sources:
            p.add_(1.0)
    updater.step()
    for old, now in zip(start, parameters(loss, "cost_qvalue", target=True), strict=True):
        torch.testing.assert_close(now, old + 0.25)
        assert not now.requires_grad


@each_loss
def test_ensemble_members_differ_and_can_be_given(kind):
    loss = make_loss(kind, 2, num_cost_qvalue_nets=3)
    first, second, third = parameters(loss, "cost_qvalue")[0]
    assert not torch.equal(first, second)
    assert not torch.equal(second, third)
    members = [make_cost_critic(2) for _ in range(2)]
    given = kind(make_actor(kind), make_q_critic(), members, num_costs=2, **OWN[kind])
    weights = given.cost_qvalue_network_params["module", "body", "0", "weight"]
    for index, member in enumerate(members):
        assert torch.equal(weights[index], member.module.body[0].weight)


RULES = {
    "dual-ascent": lambda loss: DualAscent(loss, cost_limit=torch.tensor([1.0, 5.0]), lr=0.5),
    "pid": lambda loss: PIDControl(
        loss, cost_limit=torch.tensor([1.0, 5.0]), kp=0.0, ki=0.5, normalize=False, pessimism=0.0
    ),
}


@pytest.mark.parametrize("rule", RULES)
@each_loss
def test_every_rule_moves_the_multipliers(kind, rule):
    loss = make_loss(kind, 2)
    updater = RULES[rule](loss)
    updater.step(torch.tensor([[2.0, 0.0], [4.0, 0.0]]))
    assert loss.lagrange_multiplier.tolist() == [1.0, 0.0]
    updater.step(torch.empty(0, 2))
    losses = loss(make_transitions(2))
    assert (losses["lagrange_multiplier_0"], losses["lagrange_multiplier_1"]) == (1.0, 0.0)


@each_loss
def test_the_multiplier_moves_like_the_temperature_of_sac(kind):
    """Adam on a logarithm along the violation: the loss of SACLoss on its log_alpha."""
    loss = make_loss(kind, multiplier_init=0.5)
    updater = DualAscent(
        loss,
        cost_limit=2.0,
        lr=0.1,
        optimizer=torch.optim.Adam,
        parametrization=torch.distributions.ExpTransform(),
    )
    log_multiplier = nn.Parameter(torch.tensor([0.5]).log())
    optimizer = torch.optim.Adam([log_multiplier], lr=0.1)
    for cost in (3.0, 7.0, 1.0, 0.0):
        updater.step(torch.tensor([[cost]]))
        (-log_multiplier * (cost - 2.0)).sum().backward()
        optimizer.step()
        optimizer.zero_grad()
        torch.testing.assert_close(loss.lagrange_multiplier, log_multiplier.exp().detach())
    assert loss.lagrange_multiplier.item() != pytest.approx(0.5, abs=0.05)


@each_loss
def test_the_multiplier_is_a_buffer_and_no_parameter(kind):
    loss = make_loss(kind, 2, multiplier_init=1.5)
    assert not any("multiplier" in name for name, _ in loss.named_parameters())
    optimizer = torch.optim.Adam(loss.parameters(), lr=1.0)
    losses = loss(make_transitions(2))
    sum(losses[key] for key in trained_losses(loss)).backward()
    optimizer.step()
    assert loss.lagrange_multiplier.tolist() == [1.5, 1.5]
    address = loss.lagrange_multiplier.data_ptr()
    loss.lagrange_multiplier = 0.5
    assert loss.lagrange_multiplier.tolist() == [0.5, 0.5]
    assert loss.lagrange_multiplier.data_ptr() == address
    assert losses["lagrange_multiplier_0"].item() == 1.5


@each_loss
def test_without_delay_there_are_no_target_cost_critics(kind):
    loss = make_loss(kind, 2, delay_qvalue=False)
    assert not any(name.startswith("target_cost_qvalue") for name, _ in loss.named_children())


@each_loss
def test_the_actor_loss_trains_no_critic(kind):
    """With a multiplier: at zero a gradient would not show."""
    loss = make_loss(kind, multiplier_init=1.0)
    call(loss, make_transitions())["loss_actor"].backward()
    assert networks_with_gradient(loss) == {"actor"}


def test_bounds_in_double_precision_leave_the_next_action_single():
    """Safety-Gymnasium's and DMControl's action specs are of such numbers."""
    batch, losses = make_transitions(1), []
    for dtype in (torch.float32, torch.float64):
        torch.manual_seed(0)
        networks = make_q_networks(1, deterministic=True)
        spec = Bounded(-0.1, 0.1, batch["action"].shape[-1:], dtype=dtype)
        loss = TD3LagrangianLoss(*networks, action_spec=spec)
        SoftUpdate(loss, tau=0.1)  # TorchRL warns without.
        losses.append(loss(batch.clone()))
    assert losses[0]["loss_qvalue"] == losses[1]["loss_qvalue"]
    assert losses[0]["loss_cost_qvalue"] == losses[1]["loss_cost_qvalue"]
