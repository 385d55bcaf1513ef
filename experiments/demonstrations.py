"""Starts a policy from what a pilot would do, before it learns from rewards.

Random actions hardly ever push a cube to its goal, and never pick one up: there is no reward to
begin with. So the pilot acts first, with noise in its actions, so that it also shows how to recover
from errors (DART, Laskey et al. 2017, arXiv 1703.09327). Then the policy acts. In every state the
pilot says what it would have done, and the policy learns that (DAgger, Ross et al. 2011, arXiv
1011.0686): a policy that only imitates good episodes does not know what to do after a mistake.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.objectives import LossModule

from experiments.agent import Standardize
from experiments.algorithms import Training
from experiments.config import Config
from experiments.pilots import CAREFUL, HURRIED, Care, act, make_pilot
from torchrl_safe.envs import ArmEnv

#: How far the pilot keeps off obstacles, by the names that options give it.
CARE: dict[str, Care] = {"careful": CAREFUL, "hurried": HURRIED}
# Share of the control steps in which the pilot acts, and the deviation of its noise.
_FIRST, _NOISE = 0.25, 0.2
# Control steps of each world before the policy learns again; passes over a sample of that size from
# all steps so far; and passes over all steps in the end.
_STEPS, _TIMES, _LAST_TIMES = 32, 50, 40
# Control steps in a minibatch, and Adam's learning rate, which falls to 0 in the end.
_SIZE, _RATE = 512, 5e-3
# How often the critics look again at what the learnt policy has earned and cost, and how long.
_LOOKS, _PASSES = 6, 4


def start_from_demonstrations(training: Training, env: TransformedEnv, config: Config) -> None:
    """Teaches the policy what the pilot does, and the critics what the policy then earns and costs.

    Args:
        training: what is to be trained, with an on-policy loss.
        env: the environment of its training.
        config: ``demonstrations``, the control steps in which the pilot says what it would do, and
            ``care``, how far it keeps off obstacles.
    """
    imitation = Imitation(training.actor)
    stage = Stage(env, CARE[config.care])
    new = _STEPS * env.batch_size.numel()
    rounds = max(2, round(config.demonstrations / new))
    flown = max(1, round(_FIRST * rounds))
    for index in range(rounds):
        if index < flown:
            imitation.add(stage.play(_STEPS, _with_noise))
            continue
        if index == flown:
            standardize(training.loss, imitation.seen["observation"])
        imitation.learn(_TIMES * new)
        # Every other time without noise. There are states in which the policy hesitates and stops
        # for good, and with noise it never shows them.
        imitation.add(stage.play(_STEPS, training.actor, noise=bool(index % 2)))
    imitation.learn(_LAST_TIMES * rounds * new, settle=True)
    played = Stage(env).play(env.base_env.max_episode_steps, training.actor)
    fit_critics(training.loss, played, config.learning_rate)


class Stage:
    """An environment that goes on where it was, and its pilot.

    Args:
        env: the environment; it is reset.
        care: how far the pilot keeps off obstacles.
    """

    def __init__(self, env: TransformedEnv, care: Care = CAREFUL) -> None:
        arm = env.base_env
        assert isinstance(arm, ArmEnv)
        self.env, self.arm, self.pilot = env, arm, make_pilot(arm, care)
        self.now = env.reset()

    @torch.no_grad()
    def play(
        self,
        steps: int,
        policy: Callable[[TensorDictBase], TensorDictBase],
        *,
        noise: bool = True,
    ) -> TensorDictBase:
        """Plays on, ``(worlds, steps)``; ``advice`` is what the pilot would have done."""
        played = []
        kind = ExplorationType.RANDOM if noise else ExplorationType.DETERMINISTIC
        with set_exploration_type(kind):
            for _ in range(steps):
                advice = act(self.arm, self.pilot)
                self.now["advice"] = torch.as_tensor(advice, dtype=torch.float32)
                step, self.now = self.env.step_and_maybe_reset(policy(self.now))
                played.append(step)
        return torch.stack(played, dim=1)


def _with_noise(tensordict: TensorDictBase) -> TensorDictBase:
    advice = tensordict["advice"]
    return tensordict.set("action", advice + _NOISE * torch.randn_like(advice))


class Imitation:
    """Makes what has been advised likely: behaviour cloning.

    Args:
        actor: the policy.
    """

    def __init__(self, actor: TensorDictModuleBase) -> None:
        self.actor = actor
        self.optimizer = torch.optim.Adam(actor.parameters(), lr=_RATE, fused=True)
        self.seen: TensorDictBase = TensorDict({}, [0])

    def add(self, played: TensorDictBase) -> None:
        """Remembers states and what was advised in them."""
        new = played.select(*self.actor.in_keys).set("action", played["advice"]).reshape(-1)
        self.seen = torch.cat([self.seen, new]) if len(self.seen) else new

    def learn(self, steps: int, *, settle: bool = False) -> None:
        """Learns from steps drawn from all that it remembers; to settle, at a rate that falls."""
        minibatches = math.ceil(steps / _SIZE)
        for index in range(minibatches):
            self.optimizer.param_groups[0]["lr"] = _RATE * (1 - settle * index / minibatches)
            minibatch = self.seen[torch.randint(len(self.seen), (_SIZE,))]
            likelihood = self.actor.get_dist(minibatch).log_prob(minibatch["action"])
            likelihood.mean().neg().backward()
            self.optimizer.step()
            self.optimizer.zero_grad()


def standardize(loss: LossModule, seen: Tensor) -> None:
    """Gives what the networks see mean 0 and deviation 1 in the demonstrations.

    The networks do not see what is always the same there, such as an obstacle's size. Its weights
    would stay random, and another size would change the actions at random.
    """
    deviation = seen.std(0)
    scale = torch.where(deviation > 1e-4, 1 / deviation.clamp_min(0.02), 0)
    for module in loss.modules():
        if isinstance(module, Standardize):
            module.loc.copy_(-seen.mean(0) * scale)
            module.scale.copy_(scale)


def fit_critics(loss: Any, played: TensorDictBase, rate: float) -> None:
    """Fits the critics to what the policy has earned and cost; it stays as it is."""
    critics = [each for name, each in loss.named_parameters() if "critic" in name]
    optimizer = torch.optim.Adam(critics, lr=2 * rate, fused=True)
    for _ in range(_LOOKS):
        data = loss.estimate_advantages(played.clone(False)).reshape(-1).exclude("next")
        for _ in range(_PASSES):
            for minibatch in data[torch.randperm(len(data))].split(256):
                # Not a call of the loss, in which a KL penalty adapts to a policy that rests.
                parts = loss.loss_critic(minibatch)[0], loss.loss_cost_critic(minibatch)[0]
                sum(part.mean() for part in parts).backward()
                optimizer.step()
                loss.zero_grad()
