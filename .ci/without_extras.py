"""What of the installed package works without extras, and what asks for which extra.

Run by .ci/test-wheel, outside the checkout.
"""

from importlib import import_module
from importlib.resources import files

import numpy as np
import torch
from tensordict import TensorDict
from tensordict.nn import NormalParamExtractor, TensorDictModule
from torchrl.data import Bounded, Composite, Unbounded
from torchrl.envs import Compose, EnvBase, RewardSum, StepCounter, TransformedEnv
from torchrl.modules import MLP, ProbabilisticActor, TanhNormal, ValueOperator

import torchrl_safe
from torchrl_safe.checkpoint import RunCheckpoints
from torchrl_safe.collectors import ResumableCollector
from torchrl_safe.envs import ArmEnv, CostToReward, EarlyTermination
from torchrl_safe.objectives import DualAscent, PPOLagrangianLoss
from torchrl_safe.policy import load_policy, save_policy, shipped_policies
from torchrl_safe.trainers import MultiplierHook


def refused(use, extra):
    """Raises unless something asks for an extra by name."""
    try:
        use()
    except ImportError as error:
        message = str(error)
    else:
        message = "no error"
    assert f'pip install "torchrl-safe[{extra}]"' in message, message


package = files("torchrl_safe")
assert "site-packages" in str(package), package
assert (package / "py.typed").is_file()
assert (package / "envs" / "arms" / "gripper.urdf").is_file()
assert torchrl_safe.__version__

refused(ArmEnv, "arms")
refused(lambda: import_module("torchrl_safe.envs.gym"), "arms")
refused(lambda: import_module("torchrl_safe.metrics"), "metrics")
refused(lambda: import_module("torchrl_safe.evaluation"), "metrics")
refused(lambda: import_module("torchrl_safe.trainers.configs"), "hydra")


class Point(EnvBase):
    """A point on a line: its speed is the cost."""

    def __init__(self):
        super().__init__()
        self.observation_spec = Composite(observation=Unbounded(2), cost=Unbounded(1))
        self.action_spec = Bounded(-1, 1, (1,))
        self.reward_spec = Unbounded(1)

    def _reset(self, tensordict=None):
        return TensorDict(observation=torch.zeros(2), cost=torch.zeros(1))

    def _step(self, tensordict):
        where, action = tensordict["observation"][0], tensordict["action"]
        observation = torch.cat([where[None] + 0.1 * action, action])
        return TensorDict(
            observation=observation,
            cost=action.abs(),
            reward=-(where - 1).abs()[None],
            done=torch.zeros(1, dtype=torch.bool),
        )

    def _set_seed(self, seed):
        torch.manual_seed(seed or 0)


# Two batches with a part of every kind.
env = TransformedEnv(
    Point(),
    Compose(
        StepCounter(20),
        CostToReward(),
        RewardSum(["reward", "cost"], ["episode_reward", "episode_cost"]),
        EarlyTermination(5.0, termination_reward=-20.0),
    ),
)
net = torch.nn.Sequential(MLP(2, 2, num_cells=[8]), NormalParamExtractor())
net = TensorDictModule(net, ["observation"], ["loc", "scale"])
actor = ProbabilisticActor(net, net.out_keys, distribution_class=TanhNormal, return_log_prob=True)
critic = ValueOperator(MLP(2, 1, num_cells=[8]), ["observation"])
cost_critic = ValueOperator(MLP(2, 1, num_cells=[8]), ["observation"], ["cost_value"])
loss = PPOLagrangianLoss(actor, critic, cost_critic, entropy_bonus=False)
updater = DualAscent(loss, cost_limit=0.1, lr=0.5)
collector = ResumableCollector(
    env, actor, frames_per_batch=100, total_frames=200, auto_register_policy_transforms=False
)
checkpoints = RunCheckpoints("checkpoints", {"loss": loss, "updater": updater})
hook = MultiplierHook(updater)
for batch in collector:
    hook(batch)
    losses = loss(loss.estimate_advantages(batch).reshape(-1))
    sum(value for key, value in losses.items() if key.startswith("loss_")).backward()
    checkpoints.save(1)
assert loss.lagrange_multiplier > 0
assert checkpoints.load() == 1
save_policy("policy.pt", actor, env.observation_spec_unbatched)
assert load_policy("policy.pt")(np.zeros(2)).shape == (1,)
assert shipped_policies()
for name in shipped_policies():
    shipped = load_policy(name)
    assert shipped(np.zeros(shipped.observation_shape)).shape == shipped.action_shape
print("Losses, rules, transforms, checkpoints and policies work without extras.")
