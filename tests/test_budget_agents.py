"""Budgets of several agents: a tally for each."""

import pytest
import torch
from tensordict import TensorDict
from torch.testing import assert_close
from torchrl.collectors import Collector
from torchrl.data import Composite, Unbounded
from torchrl.envs import EnvBase, TransformedEnv
from torchrl.envs.utils import check_env_specs

from torchrl_safe.envs import EarlyTermination, Saute


class Crew(EnvBase):
    """Two worlds with three agents, which have costs and perhaps done flags of their own.

    In each step agent a costs a + 1, of each of two costs. World 0 ends after two steps.
    """

    def __init__(self, ends_by_agent):
        super().__init__(batch_size=(2,))
        self.ends_by_agent = ends_by_agent

        def agents(**specs):
            return Composite(agents=Composite(specs, shape=(2, 3)), shape=(2,))

        self.observation_spec = agents(observation=Unbounded((2, 3, 1)))
        self.action_spec = agents(action=Unbounded((2, 3, 1)))
        self.reward_spec = agents(reward=Unbounded((2, 3, 1)), cost=Unbounded((2, 3, 2)))
        names = ("done", "terminated", "truncated")
        if ends_by_agent:
            self.done_spec = agents(**{n: Unbounded((2, 3, 1), dtype=torch.bool) for n in names})
        else:
            flags = {n: Unbounded((2, 1), dtype=torch.bool) for n in names}
            self.done_spec = Composite(flags, shape=(2,))
        self.time = torch.zeros(2, 1)

    def state(self, **entries):
        ended = self.time >= torch.tensor([[2.0], [100.0]])
        everyone = self.time[:, None].expand(2, 3, 1)
        agents = {"observation": everyone.clone(), **entries}
        flags = {"done": ended, "terminated": ended.clone(), "truncated": torch.zeros_like(ended)}
        if self.ends_by_agent:
            agents |= {name: flag[:, None].expand(2, 3, 1).clone() for name, flag in flags.items()}
            flags = {}
        return TensorDict({"agents": TensorDict(agents, (2, 3)), **flags}, (2,))

    def _reset(self, tensordict=None, **kwargs):
        key = ("agents", "_reset") if self.ends_by_agent else "_reset"
        mask = None if tensordict is None else tensordict.get(key, None)
        some = torch.ones(2, 1) if mask is None else mask.reshape(2, -1)[:, :1]
        self.time = torch.where(some.bool(), 0.0, self.time)
        return self.state()

    def _step(self, tensordict):
        self.time = self.time + 1
        cost = torch.arange(1.0, 4.0)[:, None].expand(2, 3, 2).clone()
        return self.state(reward=torch.ones(2, 3, 1), cost=cost)

    def _set_seed(self, seed):
        pass


AGENTS = {"cost_key": ("agents", "cost"), "reward_key": ("agents", "reward")}


@pytest.mark.parametrize(
    ("kind", "ends_by_agent"), [("saute", False), ("saute", True), ("early", True)]
)
def test_each_agent_has_a_tally(kind, ends_by_agent):
    keys = {**AGENTS, "out_key": ("agents", "tally")}
    if kind == "saute":
        transform = Saute(100.0, unsafe_reward=-1.0, **keys)
    else:  # It wants a done flag for each agent that has a budget.
        flags = {"terminated_key": ("agents", "terminated"), "done_key": ("agents", "done")}
        transform = EarlyTermination(100.0, **keys, **flags)
    env = TransformedEnv(Crew(ends_by_agent), transform)
    check_env_specs(env)
    collector = Collector(env, frames_per_batch=8, total_frames=8)
    (batch,) = collector
    collector.shutdown()
    assert batch["agents"].batch_size == (2, 4, 3)
    tally = batch["next", "agents", "tally"][..., 0]
    used = 100 * (1 - tally) if kind == "saute" else tally
    steps = torch.tensor([[1, 2, 1, 2], [1, 2, 3, 4]])  # World 0 begins anew after two.
    assert_close(used, steps[:, :, None] * torch.arange(1.0, 4.0), atol=1e-4, rtol=0)


def test_the_tallies_of_agents_may_stand_in_a_group_of_their_own():
    saute = Saute(100.0, unsafe_reward=-1.0, **AGENTS, out_key=("budget", "left"))
    env = TransformedEnv(Crew(ends_by_agent=False), saute)
    check_env_specs(env)
    assert env.rollout(2)["next", "budget", "left"].shape == (2, 2, 3, 2)


def test_the_nearest_mask_begins_a_tally_anew():
    transform = EarlyTermination(9.0, out_key=("agents", "used"))
    own = torch.tensor([[True, False]] * 3).unsqueeze(-1)
    data = TensorDict({"_reset": torch.ones(3, 1, dtype=torch.bool)}, [3])
    data["agents", "_reset"], data["agents", "used"] = own, torch.ones(3, 2, 1)
    used = transform._reset(data, TensorDict({}, [3]))["agents", "used"]
    assert torch.equal(used, 1.0 - own.float())
