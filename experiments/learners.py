"""What is done with each collected batch: learning on policy, in a trust region, from replay."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any, Protocol

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torch.distributions import Distribution, kl_divergence
from torch.optim.lr_scheduler import LinearLR, LRScheduler
from torchrl.data import (
    LazyTensorStorage,
    RandomSampler,
    TensorDictReplayBuffer,
)
from torchrl.objectives import LossModule, SoftUpdate

from torchrl_safe.objectives import TrustRegionStep

# What a loss does not read once there are advantages; left out, minibatches are cut faster.
NOT_LEARNT_FROM = (
    "next",
    "done",
    "terminated",
    "truncated",
    "success",
    "episode_reward",
    "episode_cost",
    "step_count",
    ("collector", "traj_ids"),
)
# What is minimized: a number for a minibatch.
Objective = Callable[[TensorDictBase], Tensor]


class Learner(Protocol):
    """Learns from one collected batch after the other."""

    def learn(self, batch: TensorDictBase) -> None:
        """Learns from a batch as a collector returns it."""

    def state(self) -> dict[str, Any]:
        """What has been learnt, and all that it takes to go on learning."""


def summed(loss: Callable[[TensorDictBase], TensorDictBase]) -> Objective:
    """A loss as the one number that is minimized."""

    def total(minibatch: TensorDictBase) -> Tensor:
        return sum(value for key, value in loss(minibatch).items() if key.startswith("loss_"))

    return total


def moved_from_here(actor: TensorDictModuleBase, data: TensorDictBase) -> Callable[[], float]:
    """Returns a function that says how far a policy has moved since this call.

    It returns the divergence from the policy as it is now, in nats: a mean over the states.
    """

    @torch.no_grad()
    def policy() -> Distribution:
        return actor.get_dist(data.select(*actor.in_keys))

    before = policy()
    return lambda: kl_divergence(before, policy()).mean().item()


class NoiseSchedule:
    """Moves the standard deviation of a policy from batch to batch, geometrically.

    If it falls, the policy measured at the end of training is nearly the one that is deployed
    without noise, and so is its cost.

    Args:
        log_std: logarithm of the standard deviation; changed in place.
        last: its value after all batches.
        batches: how many batches there will be.
    """

    def __init__(self, log_std: torch.nn.Parameter, *, last: float, batches: int) -> None:
        self.log_std, self.last, self.batches = log_std.requires_grad_(False), last, batches
        self.first, self.steps = log_std.clone(), 0

    def step(self) -> None:
        self.steps += 1
        self.log_std.copy_(
            self.first.lerp(self.first.new_tensor(self.last), self.steps / self.batches)
        )

    def state_dict(self) -> dict[str, Any]:
        return {"first": self.first, "steps": self.steps}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self.first, self.steps = state_dict["first"], state_dict["steps"]


def tell_length(step: TrustRegionStep, batch: TensorDictBase) -> None:
    """Tells a trust-region step how long the episodes are that ended in a batch.

    What a limit is about, an episode, is then in the unit of the surrogates. The batch needs a
    :class:`~torchrl.envs.StepCounter`.
    """
    lengths = batch["next", "step_count"][batch["next", "done"]]
    if len(lengths):
        step.episode_length = lengths.float().mean().item()


class OnPolicyLearner:
    """Goes through each batch some times in minibatches, then forgets it.

    Args:
        loss: an on-policy loss with ``estimate_advantages``.
        actor: the policy in it.
        noise: lowers the noise of the policy after each batch.
        learning_rate: Adam's, of the policy; that of the critics is twice as high, and both fall
            linearly to 0 over ``batches``.
        batches: how many batches there will be.
        epochs: passes over each batch, in each phase.
        minibatch: control steps in a minibatch.
        phases: what is minimized, one after the other, each with what is to be done before.
        max_kl: a phase ends after the gradient step that has moved the policy further than this
            mean divergence, in nats.
        actor_step: moves the actor instead of the optimizer.
    """

    def __init__(
        self,
        loss: LossModule,
        actor: TensorDictModuleBase,
        noise: NoiseSchedule,
        *,
        learning_rate: float,
        batches: int,
        epochs: int,
        minibatch: int,
        phases: Sequence[tuple[Callable[[], None] | None, Objective]],
        max_kl: float = math.inf,
        actor_step: TrustRegionStep | None = None,
    ) -> None:
        self.loss, self.actor, self.noise, self.actor_step = loss, actor, noise, actor_step
        self.epochs, self.minibatch, self.max_kl = epochs, minibatch, max_kl
        self.phases = phases
        self.policy = list(actor.parameters())
        moved_here = {id(parameter) for parameter in self.policy}
        critics = [p for p in loss.parameters() if id(p) not in moved_here]
        groups = [{"params": critics, "lr": 2 * learning_rate}]
        if actor_step is None:
            groups.append({"params": self.policy, "lr": learning_rate})
        self.optimizer = torch.optim.Adam(groups, fused=True)
        self.schedule = _falling(self.optimizer, batches)

    def learn(self, batch: TensorDictBase) -> None:
        data = self.loss.estimate_advantages(batch).reshape(-1)
        if self.actor_step is not None:
            tell_length(self.actor_step, batch)
            self.actor_step.step(data)
        data = data.exclude(*NOT_LEARNT_FROM)
        for prepare, objective in self.phases:
            if prepare is not None:
                prepare()
            moved = moved_from_here(self.actor, data) if self.max_kl < math.inf else None
            for minibatch in self._minibatches(data):
                _descend(objective(minibatch), self.optimizer, self.policy)
                if moved is not None and moved() > self.max_kl:
                    break
        self.schedule.step()
        self.noise.step()

    def _minibatches(self, data: TensorDictBase) -> Iterator[TensorDictBase]:
        for epoch in range(self.epochs):
            # All passes have the same shapes and modules, so the first checks them for all.
            with torch.compiler.set_stance(skip_guard_eval_unsafe=epoch > 0):
                yield from data[torch.randperm(len(data))].split(self.minibatch)

    def state(self) -> dict[str, Any]:
        state = {
            "loss": self.loss,
            "optimizer": self.optimizer,
            "schedule": self.schedule,
            "noise": self.noise,
        }
        return state if self.actor_step is None else {**state, "actor_step": self.actor_step}


class ReplayLearner:
    """Keeps all batches and takes gradient steps on samples of them.

    Args:
        loss: an off-policy loss with target networks.
        actor: the policy in it.
        learning_rate: Adam's, of all networks; it falls linearly to 0 over ``batches``.
        batches: how many batches there will be.
        capacity: control steps to keep.
        minibatch: control steps in a sample.
        steps_per_update: collected control steps for each gradient step.
    """

    def __init__(
        self,
        loss: LossModule,
        actor: TensorDictModuleBase,
        *,
        learning_rate: float,
        batches: int,
        capacity: int,
        minibatch: int,
        steps_per_update: int,
    ) -> None:
        self.loss, self.steps_per_update = loss, steps_per_update
        self.targets = SoftUpdate(loss, tau=0.005)
        self.objective = summed(loss)
        self.policy = list(actor.parameters())
        self.optimizer = torch.optim.Adam(loss.parameters(), lr=learning_rate, fused=True)
        self.schedule = _falling(self.optimizer, batches)
        self.buffer = TensorDictReplayBuffer(
            storage=LazyTensorStorage(capacity), sampler=RandomSampler(), batch_size=minibatch
        )

    def learn(self, batch: TensorDictBase) -> None:
        self.buffer.extend(batch.reshape(-1))
        for _ in range(batch.numel() // self.steps_per_update):
            _descend(self.objective(self.buffer.sample()), self.optimizer, self.policy)
            self.targets.step()
        self.schedule.step()

    def state(self) -> dict[str, Any]:
        return {
            "loss": self.loss,
            "optimizer": self.optimizer,
            "schedule": self.schedule,
            "buffer": self.buffer,
        }


def _falling(optimizer: torch.optim.Optimizer, batches: int) -> LRScheduler:
    """Learning rates that fall linearly to 0."""
    return LinearLR(optimizer, 1.0, 0.0, total_iters=batches)


def _descend(
    loss: Tensor, optimizer: torch.optim.Optimizer, policy: list[torch.nn.Parameter]
) -> None:
    loss.backward()
    # One step with NaN would destroy all that was learnt. Raise an error before it.
    moved = [parameter for group in optimizer.param_groups for parameter in group["params"]]
    gradients = [parameter.grad for parameter in moved if parameter.grad is not None]
    torch.nn.utils.get_total_norm(gradients, error_if_nonfinite=True)
    torch.nn.utils.clip_grad_norm_(policy, 0.5)
    optimizer.step()
    optimizer.zero_grad()
