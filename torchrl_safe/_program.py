"""A function of one tensor as a list of PyTorch's own operations.

:func:`record` writes down what a module computes, :class:`Program` computes it again. A recorded
program is plain data. It needs none of the code that it was recorded from, and it cannot name
anything but arithmetic on tensors: the `Core ATen operators
<https://docs.pytorch.org/docs/stable/torch.compiler_ir.html>`_, which PyTorch keeps stable.
(:func:`torch.export.load` is no substitute: it unpickles what the file holds, and other versions of
PyTorch may not read it.)
"""

from __future__ import annotations

import operator
import warnings
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor
from torch._ops import OpOverload  # The type of torch.ops.aten.*, which has no public name.

# Arithmetic on the number of rows, and choosing one of an operation's results.
_PYTHON = {
    f"python::{function.__name__}": function
    for function in (operator.add, operator.sub, operator.mul, operator.floordiv, operator.getitem)
}
_PLAIN = (bool, int, float, str, type(None), torch.dtype, torch.device, torch.layout)
# These alone cannot be read with weights_only=True.
_FORMATS = {
    str(format): format
    for format in (torch.contiguous_format, torch.preserve_format, torch.channels_last)
}
# Says where the value of another operation goes. No operation takes a dict.
_VALUE = "value"


class Program(torch.nn.Module):
    """Computes what :func:`record` has written down.

    Args:
        steps: the operations, as :func:`record` returns them.
        tensors: weights and constants by name.

    Raises:
        ValueError: if an operation is not a Core ATen operator.
    """

    def __init__(self, steps: Sequence[Sequence[Any]], tensors: Mapping[str, Tensor]) -> None:
        super().__init__()
        self._steps = [list(step) for step in steps]
        self._tensors = dict(tensors)
        self._operations = [operation(name) for name, _, _ in self._steps]

    def forward(self, rows: Tensor) -> Tensor:
        """Computes the result for each row, shape ``(B, ...)``."""
        values: dict[str | int, Any] = {0: rows}
        values.update(self._tensors)

        def filled(argument: Any) -> Any:
            if isinstance(argument, dict):
                return values[argument[_VALUE]]
            if isinstance(argument, list):
                return [filled(part) for part in argument]
            if isinstance(argument, str):
                return _FORMATS.get(argument, argument)
            return argument

        for number, (operate, (_, args, kwargs)) in enumerate(
            zip(self._operations, self._steps, strict=True), start=1
        ):
            values[number] = operate(
                *map(filled, args), **{name: filled(argument) for name, argument in kwargs}
            )
        return values[len(self._steps)]

    def __getstate__(self) -> dict[str, Any]:
        return {"steps": self._steps, "tensors": self._tensors}

    def __setstate__(self, state: dict[str, Any]) -> None:
        Program.__init__(self, **state)  # PyTorch's operators cannot be pickled.


def operation(name: str) -> Callable[..., Any]:
    """Returns the operation of a name such as ``"aten::add.Tensor"``.

    Raises:
        ValueError: if it is not one that a program may use.
    """
    if name in _PYTHON:
        return _PYTHON[name]
    namespace, _, rest = name.partition("::")
    packet, _, overload = rest.partition(".")
    found = getattr(getattr(torch.ops.aten, packet, None), overload or "default", None)
    if namespace == "aten" and isinstance(found, OpOverload) and _is_pure(found):
        return found
    raise ValueError(f"{name!r} is not a Core ATen operator")


def _is_pure(found: OpOverload) -> bool:
    # Core operators compute; the others also read files, for example. Three of the core operators
    # write into their arguments.
    return torch.Tag.core in found.tags and not found._schema.is_mutable


def record(
    module: torch.nn.Module, example: Tensor
) -> tuple[list[tuple[str, list[Any], list[tuple[str, Any]]]], dict[str, Tensor]]:
    """Writes down what a module computes from a batch of rows, for any number of them.

    Args:
        module: computes one tensor from one tensor. Python code in it runs once, now. A copy of
            which nothing else is wanted: its flags are changed.
        example: rows to run it with, at least two.

    Returns:
        The operations, each with its name and arguments, and the tensors that they use by name.
        Parameters and buffers have their names in the module.

    Raises:
        ValueError: if it computes something that cannot be written down.
    """
    batch = {0: torch.export.Dim("rows")}
    _make_flags_plain(module)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # PyTorch's notes to itself.
        exported = torch.export.export(module, (example,), dynamic_shapes=(batch,), strict=False)
        exported = exported.run_decompositions()
    values: dict[torch.fx.Node, str | int] = {}
    tensors: dict[str, Tensor] = {}
    stored: dict[str, Any] = {**exported.constants, **exported.state_dict}
    inputs = {spec.arg.name: spec for spec in exported.graph_signature.input_specs}
    steps: list[tuple[str, list[Any], list[tuple[str, Any]]]] = []

    def written(argument: Any) -> Any:
        if isinstance(argument, torch.fx.Node):
            return {_VALUE: values[argument]}
        if isinstance(argument, list | tuple):
            return [written(part) for part in argument]
        if isinstance(argument, _PLAIN):
            return argument
        if isinstance(argument, torch.memory_format):
            return str(argument)
        raise ValueError(f"{argument!r} cannot be an argument of a recorded operation")

    for node in _used(exported.graph):
        if node.op == "placeholder":
            name = inputs[node.name].target
            if name is None:
                values[node] = 0
            else:
                values[node] = name
                tensors[name] = stored[name]
        elif node.op == "call_function":
            name = _name(node.target)
            operation(name)
            steps.append((name, written(node.args), written(list(node.kwargs.items()))))
            values[node] = len(steps)
    return steps, tensors


def _make_flags_plain(module: torch.nn.Module) -> None:
    """Replaces buffers that are one bool by that bool.

    Some modules (:class:`~torchrl.envs.ObservationNorm`) ask them what to do, which cannot be asked
    of a tensor while it is recorded.
    """
    for part in module.modules():
        flags = dict(part.named_buffers(recurse=False))
        for name, flag in flags.items():
            if flag.dtype == torch.bool and flag.dim() == 0:
                delattr(part, name)
                setattr(part, name, bool(flag))


def _used(graph: torch.fx.Graph) -> list[torch.fx.Node]:
    """Those nodes that the result depends on, in order, without the result itself."""
    *nodes, output = graph.nodes
    (result,) = output.args[0]
    used = {result}
    for node in reversed(nodes):
        if node in used:
            used.update(node.all_input_nodes)
    return [node for node in nodes if node in used]


def _name(target: Any) -> str:
    if isinstance(target, OpOverload):
        return target.name()
    return f"python::{getattr(target, '__name__', target)}"
