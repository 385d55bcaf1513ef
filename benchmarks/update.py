"""One optimizer step of PPO-Lagrangian against TorchRL's PPO, hand-written code and SB3's PPO."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from time import process_time
from typing import Any

import gymnasium
import numpy as np
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import DummyVecEnv
from tensordict import TensorDictBase
from torch import Tensor, nn
from torchrl.objectives import ClipPPOLoss

from benchmarks.handwritten import HandWritten, arguments
from benchmarks.networks import ACTION, OBSERVATION, make_actor, make_critic, make_minibatch
from benchmarks.report import Figure
from benchmarks.timing import Contender, Times, quartiles, race, ratio, timed
from experiments.learners import summed
from torchrl_safe.objectives import PPOLagrangianLoss

_OPTIONS: dict[str, Any] = {"entropy_bonus": False, "loss_critic_type": "l2"}
# Stable-Baselines3's default, which the others share.
_MAX_GRAD_NORM = 0.5
_LEARNING_RATE = 3e-4
# Nothing compiled; the loss compiled; and without asking each time whether anything has changed
# that it was compiled for.
_KINDS = ("eager", "compiled", "compiled, guards skipped")
# For minibatches of 64.
_BARS = {
    ("eager", "ClipPPOLoss, eager"): 1.5,
    ("compiled", "hand-written, eager"): 1.3,
    ("compiled", "SB3"): 1.0,
    ("compiled, guards skipped", "hand-written, compiled, guards skipped"): 1.3,
}


class Bystander(gymnasium.Env[np.ndarray, np.ndarray]):
    """Spaces for Stable-Baselines3, and nothing that takes time."""

    observation_space = gymnasium.spaces.Box(-1, 1, (OBSERVATION,), np.float32)
    action_space = gymnasium.spaces.Box(-1, 1, (ACTION,), np.float32)

    def reset(self, **kwargs: object) -> tuple[np.ndarray, dict[str, object]]:
        return self.observation_space.sample(), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, object]]:
        return self.observation_space.sample(), 0.0, False, False, {}


def update(module: nn.Module, objective: Callable[[], Tensor]) -> Callable[[], None]:
    """Forward, backward, clipped gradient and a fused Adam step."""
    parameters = list(module.parameters())
    optimizer = torch.optim.Adam(parameters, lr=_LEARNING_RATE, fused=True)

    def step() -> None:
        objective().backward()
        nn.utils.clip_grad_norm_(parameters, _MAX_GRAD_NORM)
        optimizer.step()
        optimizer.zero_grad()

    return step


def modules() -> dict[str, tuple[nn.Module, Callable[..., Tensor]]]:
    """What is trained and what is minimized, by name."""
    by_hand = HandWritten()
    losses = {
        "ClipPPOLoss": ClipPPOLoss(make_actor(), make_critic("state_value"), **_OPTIONS),
        "PPOLagrangianLoss": PPOLagrangianLoss(
            make_actor(), make_critic("state_value"), make_critic("cost_value"), **_OPTIONS
        ),
    }
    return {
        "hand-written": (by_hand, by_hand),
        **{name: (loss, summed(loss)) for name, loss in losses.items()},
    }


def contenders(
    minibatch: TensorDictBase,
    kind: str,
    steps: int,
    clock: Callable[[], float] = process_time,
) -> dict[str, Contender]:
    """The three updates by name, where the minibatch is, each already compiled if it is to be."""
    found = {}
    for name, (module, objective) in modules().items():
        module.to(minibatch.device)
        inputs = arguments(minibatch) if name == "hand-written" else (minibatch,)
        if kind != "eager":
            objective = torch.compile(objective, fullgraph=True, dynamic=False)
        step = update(module, partial(objective, *inputs))
        step()
        contender = timed(step, calls=steps, clock=clock)
        found[f"{name}, {kind}"] = contender if "skipped" not in kind else unguarded(contender)
    return found


def unguarded(contender: Contender) -> Contender:
    """Runs what has been compiled without evaluating its guards, as torch offers after warm-up."""

    def run() -> float:
        with torch.compiler.set_stance(skip_guard_eval_unsafe=True):
            return contender()

    return run


def stable_baselines(size: int, steps: int) -> dict[str, Contender]:
    """One step of Stable-Baselines3's own ``train``, and its cutting out of the minibatch."""
    envs = min(size, 64)
    model = PPO(
        "MlpPolicy",
        DummyVecEnv([Bystander] * envs),
        n_steps=size // envs,
        batch_size=size,
        n_epochs=steps,
        learning_rate=_LEARNING_RATE,
        max_grad_norm=_MAX_GRAD_NORM,
        normalize_advantage=False,
        device="cpu",
    )
    model.learn(size)

    def train() -> float:
        return timed(model.train)() / steps

    return {
        "SB3": train,
        "SB3 sampling": timed(lambda: list(model.rollout_buffer.get(size)), calls=steps),
    }


def run(*, quick: bool) -> list[Figure]:
    """Measures all of it."""
    torch.set_num_threads(1)
    torch.manual_seed(0)
    figures: list[Figure] = []
    for size in (64,) if quick else (64, 256, 4096):
        steps, rounds = (2, 2) if quick else (max(2, 1024 // size), 15)
        minibatch = make_minibatch(size)
        rivals = stable_baselines(size, steps)
        # The contenders share their source, from which only so many graphs would be made.
        with torch._dynamo.config.patch(recompile_limit=64):
            for kind in _KINDS[:1] if quick else _KINDS:
                rivals |= contenders(minibatch, kind, steps)
            figures += summary(size, race(rivals, rounds=rounds))
    return figures


def summary(size: int, times: Times) -> Iterator[Figure]:
    """The ratios that matter, and the milliseconds of each contender."""
    rivals = {**times, "SB3": times["SB3"] - times["SB3 sampling"]}
    bars = _BARS if size == 64 else {}
    for kind in _KINDS:
        ours = times.get(f"PPOLagrangianLoss, {kind}")
        if ours is None:
            continue
        names = [f"hand-written, {kind}", "hand-written, eager", f"ClipPPOLoss, {kind}", "SB3"]
        for name in dict.fromkeys(names):
            yield ratio(
                f"minibatch {size}: PPOLagrangianLoss, {kind} / {name}",
                ours,
                rivals[name],
                at_most=bars.get((kind, name)),
            )
    yield from (
        quartiles(f"minibatch {size}: {name}", 1e3 * seconds, "ms")
        for name, seconds in times.items()
    )
