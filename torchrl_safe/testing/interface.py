"""Keys, keyword calls, states, copies, casts and compilation, as TorchRL has them."""

from __future__ import annotations

import copy
import dataclasses
import warnings
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor
from torchrl.objectives import LossModule

from torchrl_safe.testing._losses import (
    Constrain,
    MakeData,
    MakeLoss,
    MakeNetworks,
    build,
    call,
    constrained,
    loss_keys,
    named,
    require,
    require_close,
    require_equal,
    require_same_outputs,
    set_multiplier,
    total,
)
from torchrl_safe.testing.batches import make_batch, make_minibatch
from torchrl_safe.testing.networks import make_networks as make_default_networks

#: Names of the keys of an on-policy loss and of an off-policy loss, as ``set_keys`` takes them.
ON_POLICY_KEYS = (
    "advantage",
    "value_target",
    "value",
    "reward",
    "done",
    "terminated",
    "cost",
    "cost_value",
    "cost_advantage",
    "cost_value_target",
)
OFF_POLICY_KEYS = (
    "action",
    "state_action_value",
    "state_action_cost_value",
    "reward",
    "done",
    "terminated",
    "cost",
    "priority",
)


def check_keys(
    make_loss: MakeLoss,
    names: Sequence[str] = ON_POLICY_KEYS,
    *,
    nested: bool = True,
    num_costs: int = 2,
    make_networks: MakeNetworks = make_default_networks,
    make_data: MakeData = make_minibatch,
    constrain: Constrain = set_multiplier,
) -> None:
    """Checks that keys can be renamed and nested, one by one and all at once.

    To check what reads ``reward``, ``cost``, ``done`` and ``terminated`` of an on-policy loss, pass
    ``make_data=make_batch, nested=False``: data that have advantages already need none of them.

    Args:
        make_loss (callable): see :func:`check_equals_at_zero`.
        names (sequence of str, optional): which keys, as ``set_keys`` takes them. Defaults to
            ``ON_POLICY_KEYS``; ``OFF_POLICY_KEYS`` has those of Q-losses.

    Keyword Args:
        nested (bool, optional): nest the keys too. Estimators of TorchRL cannot read keys that are
            nested under ``"next"`` alone. Defaults to ``True``.
        num_costs (int, optional): number k of costs.
        make_networks (callable, optional): see :func:`check_equals_at_zero`.
        make_data (callable, optional): see :func:`check_equals_at_zero`.
        constrain (callable, optional): see :func:`check_equals_at_zero`.

    Raises:
        AssertionError: if an output differs under other keys.

    Examples:
        >>> from torchrl_safe.objectives import PPOLagrangianLoss
        >>> check_keys(PPOLagrangianLoss)
    """
    default_keys = build(make_loss, make_networks, num_costs).tensor_keys

    def run(keys: Mapping[str, NestedKey]) -> TensorDictBase:
        loss = build(make_loss, make_networks, num_costs, keys=keys)
        loss.set_keys(**keys)
        default = {name: getattr(default_keys, name) for name in keys}
        constrain(loss, torch.ones(num_costs))
        data = make_data(num_costs)
        for name, key in keys.items():
            require(
                getattr(loss.tensor_keys, name) == key,
                f"{named(loss)}: set_keys({name}={key!r}) left {getattr(loss.tensor_keys, name)!r}",
            )
            for old, new in ((default[name], key), (("next", default[name]), ("next", key))):
                old, new = unravel_key(old), unravel_key(new)
                if data.get(old, None) is not None:
                    data.rename_key_(old, new)
        try:
            return call(loss, data)
        except KeyError as error:
            raise AssertionError(f"{named(loss)} with set_keys(**{keys}): {error}") from error

    expected = run({})
    forms: list[NestedKey] = ["renamed", ("nested", "renamed")] if nested else ["renamed"]
    for name in names:
        for key in forms:
            what = f"with set_keys({name}={key!r})"
            require_same_outputs(what, run({name: key}), expected)
    every = {name: ("nested", "deeper", name) if nested else f"{name}_2" for name in names}
    require_same_outputs(f"with set_keys(**{every})", run(every), expected)


def check_dispatch(
    make_loss: MakeLoss,
    *,
    num_costs: int = 2,
    make_networks: MakeNetworks = make_default_networks,
    make_data: MakeData = make_batch,
    constrain: Constrain = set_multiplier,
) -> None:
    """Checks that a call with keyword arguments returns what a call with a tensordict does.

    Also that ``out_keys`` has every ``loss_*`` output and no other than there are, and that
    ``select_out_keys`` selects.

    Args:
        make_loss (callable): see :func:`check_equals_at_zero`.

    Keyword Args:
        num_costs (int, optional): number k of costs.
        make_networks (callable, optional): see :func:`check_equals_at_zero`.
        make_data (callable, optional): see :func:`check_equals_at_zero`.
            The data have all ``in_keys``; advantages are computed by the loss.
        constrain (callable, optional): see :func:`check_equals_at_zero`.

    Raises:
        AssertionError: if an output differs or is missing.

    Examples:
        >>> from torchrl_safe.objectives import PPOLagrangianLoss
        >>> check_dispatch(PPOLagrangianLoss)
    """
    make = partial(constrained, make_loss, make_networks, num_costs, constrain)
    loss, data = make(), make_data(num_costs)
    keys = [unravel_key(key) for key in loss.in_keys]
    duplicates = {key for key in keys if keys.count(key) > 1}
    require(not duplicates, f"{named(loss)}: in_keys has {duplicates} twice")
    keywords = {key if isinstance(key, str) else "_".join(key): data[key] for key in keys}
    expected = call(loss, data.select(*keys))
    missing = set(loss.out_keys) - set(expected.keys())
    require(not missing, f"{named(loss)}: out_keys has {sorted(missing)}, which is no output")
    silent = set(loss_keys(expected)) - set(loss.out_keys)
    require(not silent, f"{named(loss)}: out_keys lacks the output {sorted(silent)}")
    for key, output in zip(loss.out_keys, call(make(), **keywords), strict=True):
        require_close(f"{named(loss)}: output {key!r} of keywords", output, expected[key])
    chosen, loss = loss.out_keys[-2:], make()
    loss.select_out_keys(*chosen)
    outputs = call(loss, **keywords)
    require(
        loss.out_keys == chosen and len(outputs) == len(chosen),
        f"{named(loss)}: select_out_keys(*{chosen}) left {loss.out_keys}",
    )
    for key, output in zip(chosen, outputs, strict=True):
        require_close(f"{named(loss)}: selected output {key!r}", output, expected[key])


def check_input_unchanged(
    make_loss: MakeLoss,
    *,
    writes: Sequence[NestedKey] = (),
    num_costs: int = 2,
    make_networks: MakeNetworks = make_default_networks,
    make_data: MakeData = make_minibatch,
    constrain: Constrain = set_multiplier,
) -> None:
    """Checks that a loss writes nothing into the data that it is called with.

    Nor may it move its own multipliers: only a rule does.

    Args:
        make_loss (callable): see :func:`check_equals_at_zero`.

    Keyword Args:
        writes (sequence of NestedKey, optional): what it may write after all, as the priority of
            off-policy losses, ``["td_error"]``.
        num_costs (int, optional): number k of costs.
        make_networks (callable, optional): see :func:`check_equals_at_zero`.
        make_data (callable, optional): see :func:`check_equals_at_zero`.
        constrain (callable, optional): see :func:`check_equals_at_zero`.

    Raises:
        AssertionError: if an entry is new, gone or changed, or a multiplier is.

    Examples:
        >>> from torchrl_safe.objectives import PPOLagrangianLoss
        >>> check_input_unchanged(PPOLagrangianLoss)
    """
    loss = constrained(make_loss, make_networks, num_costs, constrain)
    data = make_data(num_costs)
    before = data.clone()
    constraints = _constraints(loss)
    loss(data)
    for name, buffer in _constraints(loss).items():
        require_equal(f"{named(loss)}: a call changed {name}", buffer, constraints[name])
    data = data.exclude(*writes)
    now, old = (set(each.keys(True, True)) for each in (data, before))
    require(now == old, f"{named(loss)}: entries written {now - old} and removed {old - now}")
    for key in old:
        require_equal(f"{named(loss)}: entry {key!r} of the input changed", data[key], before[key])


def _constraints(loss: LossModule) -> dict[str, Tensor]:
    """Copies of what updaters write."""
    written = ("lagrange_multiplier", "cost_violation")
    buffers = loss.named_buffers(recurse=False)
    return {name: buffer.clone() for name, buffer in buffers if name in written}


def check_state_dict(
    make_loss: MakeLoss,
    *,
    num_costs: int = 2,
    make_networks: MakeNetworks = make_default_networks,
    make_data: MakeData = make_minibatch,
    constrain: Constrain = set_multiplier,
) -> None:
    """Checks that the state goes to another loss and that copies are independent.

    A state is saved and loaded with ``strict=True`` before and after a call, for TorchRL makes
    value estimators, which are part of the state, when they are first used.

    Args:
        make_loss (callable): see :func:`check_equals_at_zero`.

    Keyword Args:
        num_costs (int, optional): number k of costs.
        make_networks (callable, optional): see :func:`check_equals_at_zero`.
        make_data (callable, optional): see :func:`check_equals_at_zero`.
        constrain (callable, optional): see :func:`check_equals_at_zero`.

    Raises:
        AssertionError: if the state does not fit, or a loss that loaded it returns something else.

    Examples:
        >>> from torchrl_safe.objectives import PPOLagrangianLoss
        >>> check_state_dict(PPOLagrangianLoss)
    """
    data = make_data(num_costs)
    for used in ("neither", "saved", "loaded"):
        saved, loaded = (build(make_loss, make_networks, num_costs, seed=seed) for seed in (0, 5))
        constrain(saved, torch.full((num_costs,), 1.5))
        for name, loss in (("saved", saved), ("loaded", loaded)):
            if name == used:
                call(loss, data)
        what = f"{named(saved)}: state of one loss in another, {used} used before"
        try:
            loaded.load_state_dict(saved.state_dict(), strict=True)
        except RuntimeError as error:
            raise AssertionError(f"{what}: {error}") from error
        require_same_outputs(what, call(loaded, data), call(saved, data))
    twin, other = copy.deepcopy(saved), copy.deepcopy(saved)
    expected = call(saved, data)
    require_same_outputs(f"{named(saved)}: deepcopy", call(twin, data), expected)
    constrain(twin, torch.zeros(num_costs))
    with torch.no_grad():
        for parameter in twin.parameters():
            parameter.add_(1.0)
    what = f"{named(saved)}: a loss after its deepcopy has changed"
    require_same_outputs(what, call(other, data), expected)


def check_cast(
    make_loss: MakeLoss,
    *,
    num_costs: int = 2,
    make_networks: MakeNetworks = make_default_networks,
    make_data: MakeData = make_minibatch,
    constrain: Constrain = set_multiplier,
) -> None:
    """Checks that a loss works in double precision after ``loss.to(torch.float64)``.

    Args:
        make_loss (callable): see :func:`check_equals_at_zero`.

    Keyword Args:
        num_costs (int, optional): number k of costs.
        make_networks (callable, optional): see :func:`check_equals_at_zero`.
        make_data (callable, optional): see :func:`check_equals_at_zero`.
        constrain (callable, optional): see :func:`check_equals_at_zero`.

    Raises:
        AssertionError: if a ``loss_*`` output or gradient has another dtype.

    Examples:
        >>> from torchrl_safe.objectives import PPOLagrangianLoss
        >>> check_cast(PPOLagrangianLoss)
    """
    data = make_data(num_costs)
    data = data.apply(lambda value: value.double() if value.is_floating_point() else value)
    for used in (False, True):
        loss = constrained(make_loss, make_networks, num_costs, constrain)
        if used:
            call(loss, make_data(num_costs))
        losses = call(loss.to(torch.float64), data)
        for key in loss_keys(losses):
            dtype = losses[key].dtype
            require(
                dtype == torch.float64,
                f"{named(loss)}: output {key!r} of a loss in double precision is {dtype}",
            )
        total(losses).backward()


@dataclasses.dataclass
class _Counter:
    """A backend of torch.compile that runs the graphs as they are, and counts them."""

    graphs: int = 0

    def __call__(self, graph: torch.fx.GraphModule, _: Any) -> Any:
        self.graphs += 1
        return graph.forward


def check_compile(
    make_loss: MakeLoss,
    *,
    num_costs: int = 2,
    make_networks: MakeNetworks = make_default_networks,
    make_data: MakeData = make_minibatch,
    constrain: Constrain = set_multiplier,
) -> None:
    """Checks that a loss compiles with ``fullgraph=True`` and sees its multipliers move.

    The graph is traced and run without code generation, so no compiler is needed. Moved
    multipliers must change the outputs without another graph. Resets what was compiled before.

    Args:
        make_loss (callable): see :func:`check_equals_at_zero`.

    Keyword Args:
        num_costs (int, optional): number k of costs.
        make_networks (callable, optional): see :func:`check_equals_at_zero`.
        make_data (callable, optional): see :func:`check_equals_at_zero`.
        constrain (callable, optional): see :func:`check_equals_at_zero`.

    Raises:
        AssertionError: if an output differs from the loss's, or a second graph is traced.
        torch._dynamo.exc.Unsupported: if the loss cannot be one graph.

    Examples:
        >>> from torchrl_safe.objectives import PPOLagrangianLoss
        >>> check_compile(PPOLagrangianLoss)
    """
    loss, data = build(make_loss, make_networks, num_costs), make_data(num_costs)
    backend = _Counter()
    torch.compiler.reset()
    compiled = torch.compile(loss, fullgraph=True, backend=backend)
    with warnings.catch_warnings():
        # tensordict 0.14 reads a dynamo option that torch 2.13 deprecates.
        warnings.filterwarnings("ignore", ".*inline_inbuilt_nn_modules", FutureWarning)
        # Dynamo warns about TorchRL's own TanhNormal.
        warnings.filterwarnings("ignore", ".*should not be instantiated", DeprecationWarning)
        totals = []
        for size in (0.0, 2.5):
            constrain(loss, torch.full((num_costs,), size))
            what = f"{named(loss)}: compiled, under constraint with strength {size}"
            (expected, slopes), (losses, actual) = (
                _with_gradients(each, loss, data) for each in (loss, compiled)
            )
            require_same_outputs(what, losses, expected, exact=False)
            for name, slope in slopes.items():
                require_close(f"{what}, gradient by {name}", actual[name], slope)
            totals.append(total(losses))
    require(
        backend.graphs == 1,
        f"{named(loss)}: constraints with another strength took {backend.graphs} graphs, not one",
    )
    require(
        bool(totals[0] != totals[1]),
        f"{named(loss)}: constraints with another strength changed no loss",
    )


def _with_gradients(
    evaluate: Callable[[TensorDictBase], TensorDictBase], loss: LossModule, data: TensorDictBase
) -> tuple[TensorDictBase, dict[str, Tensor]]:
    """Outputs, and the gradients of their sum."""
    losses = call(evaluate, data)
    names, parameters = zip(*loss.named_parameters(), strict=True)
    gradients = torch.autograd.grad(total(losses), parameters)
    return losses, dict(zip(names, gradients, strict=True))
