"""LagrangianLoss around TorchRL's multi-agent PPO: N agents, k costs of each, one done signal."""

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import NormalParamExtractor, TensorDictModule
from torchrl.modules import MultiAgentMLP, ProbabilisticActor, TanhNormal
from torchrl.objectives.multiagent import MAPPOLoss
from torchrl.objectives.value import MultiAgentGAE

from torchrl_safe.objectives import CostGAE, LagrangianLoss

# As many rows, steps and agents: what is cut along a wrong axis then fits.
ROWS = STEPS = AGENTS = 4
COSTS, WIDTH, ACTIONS = 2, 6, 2
KEYS = {"value": ("agents", "state_value"), "action": ("agents", "action")}
KEYS["sample_log_prob"] = ("agents", "action_log_prob")


def network(outputs, *, centralized):
    return MultiAgentMLP(
        n_agent_inputs=WIDTH,
        n_agent_outputs=outputs,
        n_agents=AGENTS,
        centralized=centralized,
        share_params=True,
        depth=1,
        num_cells=8,
    )


def make_actor():
    module = TensorDictModule(
        torch.nn.Sequential(network(2 * ACTIONS, centralized=False), NormalParamExtractor()),
        in_keys=[("agents", "observation")],
        out_keys=[("agents", "loc"), ("agents", "scale")],
    )
    return ProbabilisticActor(
        module,
        in_keys=[("agents", "loc"), ("agents", "scale")],
        out_keys=[KEYS["action"]],
        distribution_class=TanhNormal,
        return_log_prob=True,
        log_prob_key=KEYS["sample_log_prob"],
    )


def make_value(outputs, key):
    return TensorDictModule(
        network(outputs, centralized=True),
        in_keys=[("agents", "observation")],
        out_keys=[("agents", key)],
    )


def make_mappo():
    torch.manual_seed(0)
    loss = MAPPOLoss(
        make_actor(),
        make_value(1, "state_value"),
        normalize_advantage=False,
        entropy_bonus=False,
    )
    loss.set_keys(**KEYS)
    return loss


def make_loss(**kwargs):
    mappo = make_mappo()
    cost_critic = make_value(COSTS, "cost_value")
    loss = LagrangianLoss(mappo, cost_critic, num_costs=COSTS, **kwargs)
    loss.set_keys(cost=("agents", "cost"), cost_value=("agents", "cost_value"))
    return loss


def make_batch():
    torch.manual_seed(1)
    done = torch.rand(ROWS, STEPS, 1) < 0.3

    def agents(**entries):
        observation = torch.randn(ROWS, STEPS, AGENTS, WIDTH)
        return TensorDict(observation=observation, **entries, batch_size=[ROWS, STEPS, AGENTS])

    batch = TensorDict(
        agents=agents(),
        next=TensorDict(
            agents=agents(cost=torch.rand(ROWS, STEPS, AGENTS, COSTS)),
            reward=torch.randn(ROWS, STEPS, 1),
            done=done,
            terminated=done & (torch.rand(ROWS, STEPS, 1) < 0.5),
            batch_size=[ROWS, STEPS],
        ),
        batch_size=[ROWS, STEPS],
    )
    torch.manual_seed(2)
    with torch.no_grad():
        return make_actor()(batch)


def test_advantages_are_those_of_each_agent_alone():
    loss, batch = make_loss(normalize_cost_advantage=False), make_batch()
    loss.estimate_advantages(batch)
    # The same agent in a batch without others, whose values are known.
    values = batch["agents", "cost_value"], batch["next", "agents", "cost_value"]
    assert values[0].shape == (ROWS, STEPS, AGENTS, COSTS)
    raw = torch.empty_like(values[0])
    gae = CostGAE(gamma=0.99, lmbda=0.95, value_network=None)
    for agent in range(AGENTS):
        following = batch["next"].select("done", "terminated")
        following["cost"] = batch["next", "agents", "cost"][..., agent, :]
        following["cost_value"] = values[1][..., agent, :]
        one = TensorDict(
            cost_value=values[0][..., agent, :], next=following, batch_size=[ROWS, STEPS]
        )
        raw[..., agent, :] = gae(one)["cost_advantage"]
    torch.testing.assert_close(batch["cost_advantage"], raw - raw.mean((0, 1, 2)))
    reward = make_batch()
    peer = MultiAgentGAE(gamma=0.99, lmbda=0.95, value_network=make_mappo().critic_network)
    peer.set_keys(value=KEYS["value"])
    expected = peer(reward)["advantage"]
    # MAPPO's normalize_advantage_exclude_dims leaves each agent its own scale.
    expected = expected - expected.mean((0, 1), keepdim=True)
    expected = expected / expected.std((0, 1), keepdim=True)
    torch.testing.assert_close(batch["advantage"], expected)


def test_multiplier_zero_is_mappo_bit_for_bit():
    loss, batch = make_loss(), make_batch()
    flat = loss.estimate_advantages(batch).reshape(-1)
    got, expected = loss(flat), make_mappo()(flat)
    for key, value in expected.items():
        assert torch.equal(got[key], value), key
    assert got["loss_cost_critic"].isfinite()


def test_a_multiplier_mixes_the_advantages_of_each_agent():
    multipliers = torch.tensor([0.5, 2.0])
    loss, batch = make_loss(multiplier_init=multipliers), make_batch()
    flat = loss.estimate_advantages(batch).reshape(-1)
    mixed = flat.clone()
    penalty = (flat["cost_advantage"] * multipliers).sum(-1, keepdim=True)
    mixed["advantage"] = (flat["advantage"] - penalty) / 3.5
    expected = make_mappo()(mixed)["loss_objective"]
    torch.testing.assert_close(loss(flat)["loss_objective"], expected)
    assert not torch.isclose(make_mappo()(flat)["loss_objective"], expected)


def test_mappos_own_normalization_is_refused():
    """Its default: it would act on the mixture."""
    mappo = MAPPOLoss(make_actor(), make_value(1, "state_value"))
    with pytest.raises(ValueError, match="loss_module must not have normalize_advantage=True"):
        LagrangianLoss(mappo, make_value(COSTS, "cost_value"), num_costs=COSTS)


def test_a_cost_critic_of_the_team_is_refused():
    """Its advantages have no axis of agents, and would be mixed along another."""
    loss = make_loss(multiplier_init=1.0)
    flat = loss.estimate_advantages(make_batch()).reshape(-1)
    flat["cost_advantage"] = flat["cost_advantage"][:, 0]
    with pytest.raises(ValueError, match=r"the same \*B, got \(16, 4, 1\) and \(16, 2\)"):
        loss(flat)
