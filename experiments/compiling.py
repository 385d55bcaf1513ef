"""A loss that is called often enough is compiled."""

from __future__ import annotations

import os
import shutil
import sys
from collections.abc import Callable
from typing import TypeVar

import torch

Result = TypeVar("Result")
#: From this many gradient steps on, compiling saves more time than it takes, even the first time.
#: (Inductor keeps what it has compiled: later runs take about a third of that.)
PAYS_FROM = 10_000


def compiled(loss: Callable[..., Result], gradient_steps: int) -> Callable[..., Result]:
    """Compiles a loss if there are enough gradient steps and a compiler.

    Compiled kernels round differently from PyTorch's own, so the same seed gives another run.

    Args:
        loss: a function of a minibatch.
        gradient_steps: how often it will be called.

    Returns:
        The compiled loss, or the loss as it is.
    """
    if gradient_steps < PAYS_FROM:
        return loss
    # The compiler that inductor uses.
    compiler = os.environ.get("CXX", "clang++" if sys.platform == "darwin" else "g++")
    if shutil.which(compiler) is None:
        print(f"No C++ compiler {compiler} here: the loss is not compiled, and slower.")
        return loss
    # PyTorch keeps a limited number of graphs for each function. Drop those of earlier runs.
    torch.compiler.reset()
    return torch.compile(loss, fullgraph=True, dynamic=False)
