"""CostGAE against the recursion of Schulman et al. 2015, written out in plain Python."""

import re

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import MultiStep
from torchrl.objectives.value import MultiAgentGAE

from torchrl_safe.objectives import CostGAE, PPOLagrangianLoss
from torchrl_safe.testing import make_batch, make_critic, make_networks

GAMMA, LMBDA = 0.9, 0.7


@pytest.fixture(params=[1, 3], ids=["one-cost", "three-costs"])
def num_costs(request):
    return request.param


def with_values(num_costs):
    """A batch that holds random values, so that no network is needed."""
    batch = make_batch(num_costs)
    torch.manual_seed(2)
    batch["cost_value"] = torch.randn(*batch.shape, num_costs)
    batch["next", "cost_value"] = torch.randn(*batch.shape, num_costs)
    return batch


def recursion(batch, gamma=GAMMA, lmbda=LMBDA):
    """Advantages of every row and cost: the same formula read literally."""
    rows, steps = batch.shape
    cost, value = batch["next", "cost"].tolist(), batch["cost_value"].tolist()
    next_value = batch["next", "cost_value"].tolist()
    done, terminated = batch["next", "done"].tolist(), batch["next", "terminated"].tolist()
    advantage = torch.zeros_like(batch["next", "cost"])
    for row in range(rows):
        for column in range(advantage.shape[-1]):
            later = 0.0
            for step in reversed(range(steps)):
                bootstrap = 0.0 if terminated[row][step][0] else next_value[row][step][column]
                delta = cost[row][step][column] + gamma * bootstrap - value[row][step][column]
                later = delta + (0.0 if done[row][step][0] else gamma * lmbda * later)
                advantage[row, step, column] = later
    return advantage


def make_gae(value_network=None, gamma=GAMMA, lmbda=LMBDA, **kwargs):
    return CostGAE(gamma=gamma, lmbda=lmbda, value_network=value_network, **kwargs)


@pytest.mark.parametrize("vectorized", [True, False], ids=["vectorized", "loop"])
def test_equals_the_recursion(num_costs, vectorized):
    batch = with_values(num_costs)
    make_gae(vectorized=vectorized)(batch)
    expected = recursion(batch)
    torch.testing.assert_close(batch["cost_advantage"], expected)
    torch.testing.assert_close(batch["cost_value_target"], expected + batch["cost_value"])


@pytest.mark.parametrize(("gamma", "lmbda"), [(0.9, 0.0), (0.0, 0.7), (1.0, 1.0)])
def test_limits_of_the_discounts(gamma, lmbda):
    batch = with_values(2)
    make_gae(gamma=gamma, lmbda=lmbda)(batch)
    torch.testing.assert_close(batch["cost_advantage"], recursion(batch, gamma, lmbda))


def test_one_row_by_hand():
    # gamma = lmbda = 0.5, so the trace decays by 0.25; step 0 is truncated, step 2 terminates:
    #   step 2: delta = 4 - 1               = 3       A = 3
    #   step 1: delta = 2 + 0.5 * 1 - 2     = 0.5     A = 0.5 + 0.25 * 3 = 1.25
    #   step 0: delta = 1 + 0.5 * 10 - 2    = 4       A = 4, whatever comes after the reset
    column = torch.tensor
    batch = TensorDict(
        cost_value=column([[2.0], [2.0], [1.0]]),
        next=TensorDict(
            cost=column([[1.0], [2.0], [4.0]]),
            cost_value=column([[10.0], [1.0], [100.0]]),
            done=column([[True], [False], [True]]),
            terminated=column([[False], [False], [True]]),
            batch_size=[3],
        ),
        batch_size=[3],
    )
    make_gae(gamma=0.5, lmbda=0.5)(batch)
    torch.testing.assert_close(batch["cost_advantage"], column([[4.0], [1.25], [3.0]]))


def test_vectorized_by_default_and_equal_to_the_loop(num_costs):
    gae = make_gae()
    assert gae.vectorized
    vectorized = gae(with_values(num_costs))
    loop = make_gae(vectorized=False)(with_values(num_costs))
    torch.testing.assert_close(vectorized["cost_advantage"], loop["cost_advantage"])
    torch.testing.assert_close(vectorized["cost_value_target"], loop["cost_value_target"])


def test_truncation_bootstraps_from_the_true_next_observation(num_costs):
    critic = make_critic("cost_value", num_costs)
    gae = make_gae(critic)
    batch, truncated_row = make_batch(num_costs), (2, 3)
    assert batch["next", "truncated"][truncated_row]
    gae(batch)
    with torch.no_grad():
        value = critic(batch.select("observation"))["cost_value"]
        next_value = critic(batch["next"].select("observation"))["cost_value"]
    # The trace ends here: one-step error with the value of the observation before the reset.
    expected = batch["next", "cost"] + GAMMA * next_value - value
    torch.testing.assert_close(batch["cost_advantage"][truncated_row], expected[truncated_row])

    # Moving that observation moves this advantage; where the episode terminated it does not.
    moved = make_batch(num_costs)
    moved["next", "observation"] = moved["next", "observation"] + 1.0
    gae(moved)
    changed = (moved["cost_advantage"] - batch["cost_advantage"]).abs()
    assert (changed[truncated_row] > 1e-4).all()
    assert (changed[1, 2] == 0).all()
    assert batch["next", "terminated"][1, 2]


@pytest.mark.parametrize("name", ["average_gae", "group_key"])
def test_advantages_are_scaled_elsewhere(name):
    with pytest.raises(ValueError, match=f"{name} is not supported by CostGAE: scaled_advantages"):
        make_gae(**{name: True})


def test_displaced_steps_hold_nothing():
    """``shifted`` marks displaced steps invalid; the loss leaves them out of every mean."""
    critic = make_critic("cost_value", 3)
    batch = make_gae(critic, shifted=True)(make_batch(3))
    valid = batch["shifted_valid"]
    assert not valid.all()
    assert (batch["cost_advantage"][~valid] == 0).all()
    # Row 0 never ends, so it displaces nothing: it equals the two-call path.
    exact = make_gae(critic)(make_batch(3))["cost_advantage"]
    torch.testing.assert_close(batch["cost_advantage"][0], exact[0])


@pytest.mark.parametrize(
    ("num_costs", "num_values"), [(1, 3), (3, 1), (3, 2)], ids=lambda width: str(width)
)
def test_wrong_width_is_refused(num_costs, num_values):
    batch = make_batch(num_costs)
    gae = make_gae(make_critic("cost_value", num_values))
    shapes = f"{re.escape(str((4, 6, num_costs)))}.*{re.escape(str((4, 6, num_values)))}"
    with pytest.raises(ValueError, match=f"'cost'.*'cost_value'.*{shapes}"):
        gae(batch)


def test_nested_keys(num_costs):
    keys = {
        "advantage": ("safety", "advantage"),
        "value_target": ("safety", "target"),
        "value": ("safety", "value"),
        "reward": ("safety", "cost"),
        "done": ("ended", "done"),
        "terminated": ("ended", "terminated"),
    }
    expected = make_gae()(with_values(num_costs))
    batch = with_values(num_costs)
    batch.rename_key_("cost_value", keys["value"])
    for old, new in {"cost_value": "value", "cost": "reward"}.items():
        batch["next"].rename_key_(old, keys[new])
    for flag in ("done", "terminated"):
        batch["next"].rename_key_(flag, keys[flag])
    gae = make_gae()
    gae.set_keys(**keys)
    gae(batch)
    assert torch.equal(batch["safety", "advantage"], expected["cost_advantage"])
    assert torch.equal(batch["safety", "target"], expected["cost_value_target"])


def test_unknown_key_is_refused():
    with pytest.raises(KeyError, match="cost_limit"):
        make_gae().set_keys(cost_limit="anything")


def test_group_key_is_refused():
    with pytest.raises(ValueError, match="group_key"):
        make_gae(group_key="task")


@pytest.mark.parametrize("name", ["gamma", "lmbda"])
@pytest.mark.parametrize("value", [1.5, -0.1, float("nan"), torch.tensor([0.9, 0.9])], ids=str)
def test_discounts_out_of_range_are_refused(name, value):
    with pytest.raises(ValueError, match=f"{name} must be a number from 0 to 1, got"):
        CostGAE(**{"gamma": 0.9, "lmbda": 0.9, name: value}, value_network=None)


def test_a_discount_of_zero_that_is_loaded():
    """TorchRL's vectorized recursion fails there."""
    without, loaded = make_gae(lmbda=0.0), make_gae()
    loaded.load_state_dict(without.state_dict())
    batch = with_values(2)
    expected = without(batch.clone())["cost_advantage"]
    assert torch.equal(loaded(batch)["cost_advantage"], expected)


def test_dispatch_equals_the_tensordict_call(num_costs):
    critic = make_critic("cost_value", num_costs)
    batch = make_batch(num_costs)
    advantage, target = make_gae(critic)(
        observation=batch["observation"],
        next_observation=batch["next", "observation"],
        next_cost=batch["next", "cost"],
        next_done=batch["next", "done"],
        next_terminated=batch["next", "terminated"],
    )
    expected = make_gae(critic)(batch)
    torch.testing.assert_close(advantage, expected["cost_advantage"])
    torch.testing.assert_close(target, expected["cost_value_target"])


# ---------------------------------------------------------------- several agents


def of_agents(shape=(4, 4), agents=4, num_costs=2):
    """A batch of per-agent values and costs; done, shared, as a flag of the team."""
    torch.manual_seed(0)
    done = torch.rand(*shape, 1) < 0.3
    sizes = (*shape, agents, num_costs)
    return TensorDict(
        cost_value=torch.randn(sizes),
        next=TensorDict(
            cost=torch.rand(sizes),
            cost_value=torch.randn(sizes),
            done=done,
            terminated=done & (torch.rand(*shape, 1) < 0.5),
            batch_size=shape,
        ),
        batch_size=shape,
    )


def of_one_agent(batch, agent):
    """What one of them sees, without the axis of the agents."""
    one = batch.clone()
    for key in ("cost_value", ("next", "cost"), ("next", "cost_value")):
        one[key] = batch[key][..., agent, :]
    return one


@pytest.mark.parametrize("vectorized", [True, False], ids=["vectorized", "loop"])
@pytest.mark.parametrize("agents", [1, 3, 4])
def test_agents_that_share_a_done_signal(agents, vectorized):
    """Each agent as if alone, also where ``done`` would fit along a wrong axis."""
    batch = of_agents(agents=agents)
    got = make_gae(vectorized=vectorized)(batch.clone())
    for agent in range(agents):
        expected = recursion(of_one_agent(batch, agent))
        torch.testing.assert_close(got["cost_advantage"][..., agent, :], expected)


def test_agents_as_in_torchrl():
    """A cost of one column is what MultiAgentGAE makes of a reward."""
    batch = of_agents(num_costs=1)
    peer = MultiAgentGAE(gamma=GAMMA, lmbda=LMBDA, value_network=None)
    peer.set_keys(value="cost_value", reward="cost")
    shared = batch.clone()
    shared["next", "cost"] = batch["next", "cost"][..., 0, :]
    for data in (batch, shared):
        expected = peer(data.clone())["advantage"]
        torch.testing.assert_close(make_gae()(data)["cost_advantage"], expected)


@pytest.mark.parametrize("shared_cost", [True, False])
def test_a_signal_of_each_agent_is_that_of_all(shared_cost):
    batch = of_agents(agents=3)
    if shared_cost:
        batch["next", "cost"] = batch["next", "cost"][..., :1, :].expand(4, 4, 3, 2)
    apart = batch.clone()
    for key in ("done", "terminated"):
        apart["next", key] = batch["next", key][..., None, :].expand(4, 4, 3, 1)
    if shared_cost:
        batch["next", "cost"] = batch["next", "cost"][..., 0, :]
    one, two = make_gae()(batch), make_gae()(apart)
    torch.testing.assert_close(one["cost_advantage"], two["cost_advantage"], rtol=0, atol=0)


@pytest.mark.parametrize(
    ("key", "shape", "message"),
    [
        ("done", (4, 4), r"'done' must have the shape \(4, 4, 1\), or \(4, 1\) if agents share it"),
        ("done", (4, 4, 2, 1), r"'done' must have the shape .* got \(4, 4, 2, 1\)"),
        ("terminated", (4, 4, 3), r"'terminated' must have the shape .* got \(4, 4, 3\)"),
        ("cost", (4, 4), r"one column for each constraint, got shapes \(4, 4\) and \(4, 4, 4\)"),
    ],
)
def test_a_signal_that_fits_no_axis_is_refused(key, shape, message):
    batch = of_agents(agents=1, num_costs=4)
    batch = of_one_agent(batch, 0)
    batch["next", key] = torch.zeros(shape, dtype=batch["next", key].dtype)
    with pytest.raises(ValueError, match=message):
        make_gae()(batch)


@pytest.mark.parametrize("num_costs", [1, 2])
def test_sums_of_several_steps_are_refused(num_costs):
    """TorchRL's GAE adds them up once more, and with several costs its error gives no reason."""
    postproc = MultiStep(gamma=GAMMA, n_steps=2)
    postproc.reward_keys = ("reward", "cost")
    batch = postproc(with_values(num_costs))
    for call in (make_gae(), make_gae().value_estimate):
        with pytest.raises(ValueError, match="'steps_to_next_obs' is in the batch, which a multi"):
            call(batch)


def traced(function):
    """The function as graphs that run without code generation, so that no compiler is needed."""
    torch.compiler.reset()
    return torch.compile(function, backend="aot_eager", dynamic=False)


# tensordict 0.14 reads a dynamo option that torch 2.13 deprecates.
warns = pytest.mark.filterwarnings(
    "ignore:torch._dynamo.config.inline_inbuilt_nn_modules:FutureWarning"
)


@warns
def test_compiled_it_is_the_same(num_costs):
    gae = CostGAE(gamma=GAMMA, lmbda=LMBDA)
    expected = gae(with_values(num_costs))
    compiled = traced(gae)(with_values(num_costs))
    for key in ("cost_advantage", "cost_value_target"):
        torch.testing.assert_close(compiled[key], expected[key])
    target = traced(gae.value_estimate)(with_values(num_costs))
    torch.testing.assert_close(target, expected["cost_value_target"])


@pytest.mark.parametrize("zero", ["gamma", "lmbda"])
def test_the_value_estimate_with_a_discount_of_0(zero, num_costs):
    gae = CostGAE(**{"gamma": GAMMA, "lmbda": LMBDA, zero: 0.0})
    batch = with_values(num_costs)
    before = batch.clone()
    target = gae.value_estimate(batch)
    assert (batch == before).all()
    torch.testing.assert_close(target, gae(batch)["cost_value_target"])


@warns
@pytest.mark.integration  # Half a minute: each break of the graph is compiled by itself.
def test_a_compiled_loss_estimates_the_same_advantages():
    loss = PPOLagrangianLoss(*make_networks(2), num_costs=2, multiplier_init=0.5)
    expected = loss(loss.estimate_advantages(make_batch(2)))
    losses = traced(loss)(make_batch(2))
    torch.testing.assert_close(losses.to_dict(), expected.to_dict())
