"""What a constrained loss trains, in which direction, and on which steps and costs."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import ValueOperator
from torchrl.objectives import LossModule

from torchrl_safe.testing._losses import (
    Constrain,
    MakeData,
    MakeLoss,
    MakeNetworks,
    call,
    constrained,
    finish,
    loss_keys,
    named,
    require,
    require_close,
    require_same_outputs,
    set_multiplier,
    total,
)
from torchrl_safe.testing.batches import make_minibatch, make_transitions
from torchrl_safe.testing.networks import make_networks as make_default_networks, make_q_networks


def check_gradients(
    make_loss: MakeLoss,
    trains: Mapping[str, str] | None = None,
    *,
    num_costs: int = 2,
    make_networks: MakeNetworks = make_default_networks,
    make_data: MakeData = make_minibatch,
    constrain: Constrain = set_multiplier,
) -> None:
    """Checks that each ``loss_*`` output trains one network, and that each network is trained.

    Args:
        make_loss (callable): see :func:`check_equals_at_zero`.
        trains (mapping, optional): which network each output trains, for example
            ``{"loss_cost_critic": "cost_critic"}``. Networks are named as in the parameters of
            the loss, without ``_network_params``; outputs that are not named here may train any.

    Keyword Args:
        num_costs (int, optional): number k of costs.
        make_networks (callable, optional): see :func:`check_equals_at_zero`.
        make_data (callable, optional): see :func:`check_equals_at_zero`.
        constrain (callable, optional): see :func:`check_equals_at_zero`.

    Raises:
        AssertionError: if an output reaches no network, several, or another one than ``trains``
            says.

    Examples:
        >>> from torchrl_safe.objectives import PPOLagrangianLoss
        >>> check_gradients(PPOLagrangianLoss, {"loss_cost_critic": "cost_critic"})
    """
    loss = constrained(make_loss, make_networks, num_costs, constrain)
    losses = call(loss, make_data(num_costs))
    keys, every = loss_keys(losses), set()
    for name in [*losses.keys()]:
        trained = isinstance(losses[name], Tensor) and losses[name].requires_grad
        require(
            trained == (name in keys),
            f"{named(loss)}: output {name!r} {'has a' if trained else 'has no'} gradient",
        )
    for key in keys:
        loss.zero_grad()
        losses[key].sum().backward(retain_graph=True)
        reached = {
            _network_of(name)
            for name, parameter in loss.named_parameters()
            if parameter.grad is not None and parameter.grad.any()
        }
        require(
            len(reached) == 1,
            f"{named(loss)}: output {key!r} must train one network, trains {sorted(reached)}",
        )
        wanted = {(trains or {}).get(key, *reached)}
        require(
            reached == wanted,
            f"{named(loss)}: output {key!r} must train {wanted}, trains {reached}",
        )
        every |= reached
    loss.zero_grad()
    networks = {_network_of(name) for name, _ in loss.named_parameters()}
    require(
        every == networks,
        f"{named(loss)}: no output trains {sorted(networks - every)}, only {sorted(every)}",
    )


def _network_of(parameter: str) -> str:
    """The network of a parameter: ``actor`` for ``loss_module.actor_network_params.weight``."""
    return parameter.split("_network")[0].split(".")[-1]


def check_masked_steps(
    make_loss: MakeLoss,
    *,
    num_costs: int = 2,
    make_networks: MakeNetworks = make_default_networks,
    make_data: MakeData = make_minibatch,
    constrain: Constrain = set_multiplier,
) -> None:
    """Checks that steps which a mask leaves out count nowhere in the ``loss_*`` outputs.

    The mask is TorchRL's ``("collector", "mask")``. The values of masked steps must have no effect.
    If the loss draws no random numbers, its outputs must be those of the data without these steps.
    And where these steps hold zeros, as padding does, every gradient must be finite.

    Args:
        make_loss (callable): see :func:`check_equals_at_zero`.

    Keyword Args:
        num_costs (int, optional): number k of costs.
        make_networks (callable, optional): see :func:`check_equals_at_zero`.
        make_data (callable, optional): see :func:`check_equals_at_zero`.
        constrain (callable, optional): see :func:`check_equals_at_zero`.

    Raises:
        AssertionError: if a masked step counts, or makes a gradient infinite or NaN.

    Examples:
        >>> from torchrl_safe.objectives import PPOLagrangianLoss
        >>> check_masked_steps(PPOLagrangianLoss)
    """

    def run(data: TensorDictBase, seed: int = 7) -> TensorDictBase:
        # A new loss for each call: some, as KLPENPPOLoss, change a coefficient in a call.
        loss = constrained(make_loss, make_networks, num_costs, constrain)
        losses = call(loss, data, seed=seed)
        return losses.select(*loss_keys(losses))

    data = make_data(num_costs)
    kept = torch.arange(len(data)) % 3 != 0
    masked = data.clone().set(("collector", "mask"), kept.unsqueeze(-1))
    odd = masked.clone()
    for key in odd.keys(True, True):
        last = key if isinstance(key, str) else key[-1]
        if last in ("reward", "cost") or last.endswith(("advantage", "value_target")):
            odd[key][~kept] = 1e3
    expected = run(masked)
    require_same_outputs(
        "what the masked steps hold has an effect", run(odd), expected, exact=False
    )
    one, other = run(data, seed=1), run(data, seed=2)
    if all(torch.equal(value, other[key]) for key, value in one.items()):
        require_same_outputs("masked steps count", expected, run(data[kept]), exact=False)
    padded = masked.clone()
    for value in padded.values(True, True):
        if value.is_floating_point():
            value[~kept] = 0
    loss = constrained(make_loss, make_networks, num_costs, constrain)
    total(call(loss, padded)).backward()
    for name, parameter in loss.named_parameters():
        require(
            parameter.grad is None or bool(parameter.grad.isfinite().all()),
            f"{named(loss)}: zeros in masked steps make the gradient of {name} infinite or NaN",
        )


def check_num_costs(
    make_loss: MakeLoss,
    *,
    num_costs: int = 3,
    make_networks: MakeNetworks = make_default_networks,
    make_data: MakeData = make_minibatch,
    constrain: Constrain = set_multiplier,
) -> None:
    """Checks that each of k costs of an on-policy loss acts through its own column.

    With one cost under constraint and the others not, the gradient of the policy must be that of
    a loss that knows this cost alone; and each value of the critic must learn the targets of its
    own cost: where they are what it predicts, any others give a larger loss.

    Args:
        make_loss (callable): see :func:`check_equals_at_zero`.

    Keyword Args:
        num_costs (int, optional): number k of costs.
        make_networks (callable, optional): see :func:`check_equals_at_zero`.
        make_data (callable, optional): see :func:`check_equals_at_zero`.
            The entries of the costs are those whose name begins with ``cost``.
        constrain (callable, optional): see :func:`check_equals_at_zero`.

    Raises:
        AssertionError: if a cost acts through another column, or through none.

    Examples:
        >>> from torchrl_safe.objectives import PPOLagrangianLoss
        >>> check_num_costs(PPOLagrangianLoss)
    """
    data = make_data(num_costs)
    exact = data.clone()
    with torch.no_grad():
        cost_critic = make_networks(num_costs, seed=0, keys={})[2]
        exact["cost_value_target"] = cost_critic(data.clone())["cost_value"]
    for index in range(num_costs):
        alone = data.clone()
        for key in list(alone.keys(True, True)):
            if (key if isinstance(key, str) else key[-1]).startswith("cost"):
                alone[key] = alone[key][..., index : index + 1]
        strength = 0.7 * torch.eye(num_costs)[index]
        gradients = [
            _policy_gradient(make_loss, make_networks, constrain, each, values)[1]
            for each, values in ((data, strength), (alone, strength[index : index + 1]))
        ]
        require_close(
            f"cost {index} of {num_costs} does not act on the policy as it does alone", *gradients
        )
        moved = data.clone()
        moved["cost_value_target"][..., index] += 10.0
        loss, _ = _policy_gradient(make_loss, make_networks, constrain, data, strength)
        before, after = (total(call(loss, each)) for each in (data, moved))
        require(
            bool(after != before),
            f"{named(loss)}: the target of cost {index} has no effect on any loss",
        )
        for step in (-0.01, 0.01):
            moved = exact.clone()
            moved["cost_value_target"][..., index] += step
            before, after = (total(call(loss, each)) for each in (exact, moved))
            require(
                bool(after > before),
                f"{named(loss)}: the critic's value of cost {index} learns other targets",
            )


def check_multiplier_direction(
    make_loss: MakeLoss,
    *,
    num_costs: int = 2,
    make_networks: MakeNetworks = make_default_networks,
    make_data: MakeData = make_minibatch,
    constrain: Constrain = set_multiplier,
) -> None:
    r"""Checks that a multiplier moves the policy of an on-policy loss towards less of its cost.

    For data of the policy itself, a step against the gradient of a loss with a large multiplier
    must lower the cost's surrogate :math:`E[\pi(a|s) / \pi_{old}(a|s) A_c]`, and must be nearer
    to its steepest descent than the step without a multiplier.

    Args:
        make_loss (callable): see :func:`check_equals_at_zero`.

    Keyword Args:
        num_costs (int, optional): number k of costs.
        make_networks (callable, optional): see :func:`check_equals_at_zero`.
        make_data (callable, optional): see :func:`check_equals_at_zero`.
            The data have ``action`` and ``cost_advantage`` under these names.
        constrain (callable, optional): see :func:`check_equals_at_zero`.

    Raises:
        AssertionError: if a multiplier pushes the wrong way, or not at all.

    Examples:
        >>> from torchrl_safe.objectives import PPOLagrangianLoss
        >>> check_multiplier_direction(PPOLagrangianLoss)
    """
    actor, _, _ = make_networks(num_costs, seed=0, keys={})
    data = make_data(num_costs)
    with torch.no_grad():  # So that no ratio is clipped, and no old policy is far.
        data = call(actor, data)
    log_prob = actor.get_dist(data.clone()).log_prob(data["action"])
    surrogate = ((log_prob - log_prob.detach()).exp().unsqueeze(-1) * data["cost_advantage"]).mean(
        0
    )
    for index in range(num_costs):
        uphill = _gradient(surrogate[index], [*actor.parameters()])
        cosines = []
        for size in (0.0, 100.0):
            strength = size * torch.eye(num_costs)[index]
            loss, gradient = _policy_gradient(make_loss, make_networks, constrain, data, strength)
            cosines.append(torch.cosine_similarity(gradient, uphill, dim=0).item())
        require(
            cosines[1] > max(0.0, cosines[0]),
            f"{named(loss)}: with multiplier 100 for cost {index} a step must lower this cost; the "
            f"cosine of its gradient and the loss's is {cosines[1]:.3f} with the multiplier, "
            f"{cosines[0]:.3f} without",
        )


def check_q_multiplier_direction(
    make_loss: MakeLoss,
    *,
    num_costs: int = 2,
    make_networks: MakeNetworks = make_q_networks,
    make_data: MakeData = make_transitions,
    constrain: Constrain = set_multiplier,
) -> None:
    """Checks that each multiplier moves the policy of an off-policy loss towards less of its cost.

    The critic of the costs predicts one component of the action for each cost. A step against the
    gradient of a loss with a large multiplier must lower the mean of that component, and of no
    other component as much.

    Args:
        make_loss (callable): makes the loss, called as ``make_loss(actor, qvalue, cost_qvalue,
            num_costs=k)``.

    Keyword Args:
        num_costs (int, optional): number k of costs, at most as many as the action has numbers.
        make_networks (callable, optional): see :func:`check_equals_at_zero`.
        make_data (callable, optional): see :func:`check_equals_at_zero`.
            The data have ``observation`` and ``action`` under these names.
        constrain (callable, optional): see :func:`check_equals_at_zero`.

    Raises:
        AssertionError: if a multiplier pushes the wrong way, or acts through another column.
        ValueError: if ``num_costs`` is more than an action has numbers.

    Examples:
        >>> from functools import partial
        >>> from torchrl_safe.objectives import SACLagrangianLoss
        >>> check_q_multiplier_direction(partial(SACLagrangianLoss, target_entropy=-2.0))
    """
    actor, critic, _ = make_networks(num_costs, seed=0, keys={})
    cost_critic = ValueOperator(
        _Components(num_costs), ["observation", "action"], ["state_action_cost_value"]
    )
    loss = finish(lambda: make_loss(actor, critic, cost_critic, num_costs=num_costs), 0)
    data, parameters = make_data(num_costs), list(actor.parameters())
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        action = call(actor, data)["action"].mean(0)
    if not 1 <= num_costs <= len(action):
        raise ValueError(
            f"num_costs must be at least 1 and at most the {len(action)} numbers of an action, got "
            f"{num_costs}."
        )
    uphill = [_gradient(action[index], parameters) for index in range(num_costs)]
    for index in range(num_costs):
        constrain(loss, 100.0 * torch.eye(num_costs)[index])
        downhill = _gradient(total(call(loss, data)), parameters)
        cosines = [torch.cosine_similarity(downhill, each, dim=0).item() for each in uphill]
        require(
            cosines[index] > 0 and cosines[index] == max(cosines),
            f"{named(loss)}: with multiplier 100 for cost {index} a step must lower this cost; the "
            f"cosines of the loss's gradient and that of each cost are {cosines}",
        )


class _Components(nn.Module):
    """A critic that takes one component of the action for the value of each cost."""

    def __init__(self, num_costs: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.ones(num_costs))

    def forward(self, observation: Tensor, action: Tensor) -> Tensor:
        return self.weight * action[..., : len(self.weight)]


def _gradient(value: Tensor, parameters: list[nn.Parameter]) -> Tensor:
    parts = torch.autograd.grad(value, parameters, retain_graph=True)
    return torch.cat([part.flatten() for part in parts])


def _policy_gradient(
    make_loss: MakeLoss,
    make_networks: MakeNetworks,
    constrain: Constrain,
    data: TensorDictBase,
    strength: Tensor,
) -> tuple[LossModule, Tensor]:
    """A loss under constraint, and the gradient of the sum of its losses by the policy."""
    num_costs = len(strength)
    networks = make_networks(num_costs, seed=0, keys={})
    loss = make_loss(*networks, num_costs=num_costs)
    constrain(loss, strength)
    return loss, _gradient(total(call(loss, data)), [*networks[0].parameters()])
