"""The networks that the experiments train."""

from __future__ import annotations

import torch
from tensordict.nn import AddStateIndependentNormalScale, TensorDictModule
from torch import Tensor
from torchrl.data import Unbounded
from torchrl.envs import EnvBase
from torchrl.modules import MLP, IndependentNormal, ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.objectives import ValueEstimators

from torchrl_safe.objectives import PPOLagrangianLoss


class Affine(torch.nn.Module):
    """Shifts and scales by constants, which are saved with the network."""

    loc: Tensor
    scale: Tensor

    def __init__(self, loc: Tensor | float, scale: Tensor | float) -> None:
        super().__init__()
        self.register_buffer("loc", torch.as_tensor(loc))
        self.register_buffer("scale", torch.as_tensor(scale))

    def forward(self, x: Tensor) -> Tensor:
        return self.loc + self.scale * x


def make_agent(
    env: EnvBase, *, gamma: float, multiplier_init: float = 0.0
) -> tuple[ProbabilisticActor, PPOLagrangianLoss]:
    """Makes the policy, and the loss with the policy, both critics and the multipliers.

    Observations are standardized by what random actions bring about, and the critics predict
    the mean of a step, of which the value is ``1 / (1 - gamma)`` times as much: distances of
    centimetres and values of dozens are both out of reach of a small network that Adam has
    some hundred batches to train.

    Args:
        env: environment to read widths from, and to play in.
        gamma: discount of reward and costs.
        multiplier_init: multiplier to start with.
    """
    with torch.no_grad():
        seen = env.rollout(200, break_when_any_done=False)["observation"].flatten(0, -2)
    # What hardly moves in these steps may do so later.
    scale = seen.std(0).clamp_min(0.05)
    width, actions, costs = seen.shape[-1], env.action_spec.shape[-1], env.reward_spec["cost"]

    def network(outputs: int) -> torch.nn.Sequential:
        net = MLP(width, outputs, num_cells=[64, 64], activation_class=torch.nn.Tanh)
        # Nearly the same action and value everywhere to start with.
        torch.nn.init.orthogonal_(net[-1].weight, 0.01)
        torch.nn.init.zeros_(net[-1].bias)
        return torch.nn.Sequential(Affine(-seen.mean(0) / scale, 1 / scale), net)

    def critic(outputs: int) -> torch.nn.Sequential:
        return torch.nn.Sequential(network(outputs), Affine(0.0, 1 / (1 - gamma)))

    policy = torch.nn.Sequential(network(actions), AddStateIndependentNormalScale(actions))
    bounded = not isinstance(env.action_spec, Unbounded)
    actor = ProbabilisticActor(
        TensorDictModule(policy, ["observation"], ["loc", "scale"]),
        in_keys=["loc", "scale"],
        distribution_class=TanhNormal if bounded else IndependentNormal,
        distribution_kwargs={"tanh_loc": False} if bounded else {},
        return_log_prob=True,
    )
    loss = PPOLagrangianLoss(
        actor,
        ValueOperator(critic(1), in_keys=["observation"]),
        ValueOperator(critic(costs.shape[-1]), in_keys=["observation"], out_keys=["cost_value"]),
        num_costs=costs.shape[-1],
        multiplier_init=multiplier_init,
        entropy_bonus=False,
        loss_critic_type="l2",
    )
    discount = {"gamma": gamma, "lmbda": 0.95, "vectorized": True}
    loss.make_value_estimator(ValueEstimators.GAE, **discount)
    loss.make_cost_value_estimator(**discount)
    return actor, loss
