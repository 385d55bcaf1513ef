"""TorchRL's PPO trainer under constraints."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torchrl.collectors import BaseCollector
from torchrl.objectives import LossModule
from torchrl.trainers.algorithms import PPOTrainer

from torchrl_safe.objectives import CUPLoss, TrustRegionLoss
from torchrl_safe.objectives._checks import uncompiled
from torchrl_safe.objectives.critics.cost_critic import CostCritic
from torchrl_safe.objectives.rules.cost_updater import CostUpdater
from torchrl_safe.trainers.multiplier_hook import MultiplierHook


class ConstrainedPPOTrainer(PPOTrainer):
    """TorchRL's PPO trainer for a loss with costs and a rule that moves its multipliers.

    It is :class:`~torchrl.trainers.algorithms.PPOTrainer` with a :class:`MultiplierHook`, and with
    ``loss_module.estimate_advantages`` in place of its GAE. Like ``PPOTrainer`` it estimates
    advantages anew in each epoch, with the current critics, so the scale of the cost advantages
    (:func:`~torchrl_safe.objectives.cost_advantage_scale`) forgets with each epoch, not with each
    batch. TorchRL warns that its trainers are experimental.

    Keyword Args:
        collector (BaseCollector): yields the batches.
        loss_module (LossModule): :class:`~torchrl_safe.objectives.PPOLagrangianLoss`,
            :class:`~torchrl_safe.objectives.LagrangianLoss` or any other on-policy loss with a
            cost critic that one optimizer minimizes as it stands.
        updater (MultiplierUpdater or ViolationUpdater): moves the multipliers of ``loss_module``.
        frame_skip (int, optional): factor of the frame count. Defaults to ``1``, even if the
            environment repeats actions within a step.
        optim_steps_per_batch (int, optional): steps of the optimizer in an epoch. Defaults to
            ``None``, all minibatches of the replay buffer.
        gamma (float, optional): discount of reward and costs, with ``lmbda``: the loss gets new
            estimators with them, GAE for both. Defaults to what ``loss_module`` has.
        lmbda (float, optional): trace decay of reward and costs, with ``gamma``. Defaults to
            what ``loss_module`` has.
        add_gae (bool, optional): whether advantages are estimated here. Defaults to ``True``.
        gae (callable, optional): estimates both advantages of a batch. Defaults to
            ``loss_module.estimate_advantages``.
        done_key (NestedKey, optional): see ``PPOTrainer``. Defaults to ``"done"``.
        episode_cost_key (NestedKey, optional): see :class:`MultiplierHook`.
        **kwargs: every other keyword argument of ``PPOTrainer``, among them ``total_frames``,
            ``optimizer``, ``replay_buffer``, ``logger``, ``log_interval`` and
            ``num_epochs``.

    Raises:
        TypeError: if ``loss_module`` has no cost critic, or ``updater`` is no updater.
        ValueError: if ``loss_module`` needs another kind of loop; see also :class:`MultiplierHook`.

    Like ``PPOTrainer`` it sets the keys of the loss: pass ``reward_key``, ``done_key``,
    ``terminated_key`` and ``action_key`` here, and only the keys of the costs to
    ``loss_module.set_keys``. Where keys are nested, pass ``episode_reward_key`` and
    ``observation_key`` too: it logs them.

    A checkpoint that it writes (``checkpoint=Checkpoint(), save_trainer_file=...``) holds the state
    of the updater too, and ``load_from_file`` gives it back.

    Examples:
        >>> import torch
        >>> from tensordict.nn import NormalParamExtractor, TensorDictModule
        >>> from torchrl.collectors import Collector
        >>> from torchrl.data import LazyTensorStorage, SamplerWithoutReplacement
        >>> from torchrl.data import TensorDictReplayBuffer
        >>> from torchrl.envs import RewardSum, TransformedEnv
        >>> from torchrl.modules import ProbabilisticActor, TanhNormal, ValueOperator
        >>> from torchrl_safe.envs import ArmEnv
        >>> from torchrl_safe.objectives import DualAscent, PPOLagrangianLoss
        >>> arm = ArmEnv(num_envs=4, max_episode_steps=5)
        >>> env = TransformedEnv(arm, RewardSum(["reward", "cost"], ["reward_sum", "episode_cost"]))
        >>> policy = torch.nn.Sequential(torch.nn.Linear(40, 6), NormalParamExtractor())
        >>> actor = ProbabilisticActor(
        ...     TensorDictModule(policy, ["observation"], ["loc", "scale"]),
        ...     in_keys=["loc", "scale"],
        ...     distribution_class=TanhNormal,
        ...     return_log_prob=True,
        ... )
        >>> critic = ValueOperator(torch.nn.Linear(40, 1), ["observation"])
        >>> cost_critic = ValueOperator(torch.nn.Linear(40, 1), ["observation"], ["cost_value"])
        >>> loss = PPOLagrangianLoss(actor, critic, cost_critic, entropy_bonus=False)
        >>> trainer = ConstrainedPPOTrainer(
        ...     collector=Collector(
        ...         env, actor, frames_per_batch=40, auto_register_policy_transforms=False
        ...     ),
        ...     total_frames=80,
        ...     loss_module=loss,
        ...     updater=DualAscent(loss, cost_limit=0.5, lr=0.2),
        ...     optimizer=torch.optim.Adam(loss.parameters(), lr=5e-4),
        ...     replay_buffer=TensorDictReplayBuffer(
        ...         storage=LazyTensorStorage(40),
        ...         sampler=SamplerWithoutReplacement(),
        ...         batch_size=20,
        ...     ),
        ...     progress_bar=False,
        ... )
        >>> trainer.train()
        >>> trainer.collected_frames
        80
    """

    def __init__(
        self,
        *,
        collector: BaseCollector,
        loss_module: LossModule,
        updater: CostUpdater,
        frame_skip: int = 1,
        optim_steps_per_batch: int | None = None,
        gamma: float | None = None,
        lmbda: float | None = None,
        add_gae: bool = True,
        gae: Callable[[TensorDictBase], TensorDictBase] | None = None,
        done_key: NestedKey = "done",
        episode_cost_key: NestedKey = "episode_cost",
        **kwargs: Any,
    ) -> None:
        _check_loss(loss_module)
        hook = MultiplierHook(updater, episode_cost_key=episode_cost_key, done_key=done_key)
        if (gamma is None) != (lmbda is None):
            raise ValueError(f"gamma and lmbda must be given together, got {gamma} and {lmbda}.")
        if gamma is not None:
            loss_module.make_value_estimator(gamma=gamma, lmbda=lmbda)
            loss_module.make_cost_value_estimator(gamma=gamma, lmbda=lmbda)
        if add_gae and gae is None:
            # A function: the parent would call set_keys of an object, with the reward's key.
            gae = _estimation(loss_module, collector)
        super().__init__(
            collector=collector,
            loss_module=loss_module,
            frame_skip=frame_skip,
            optim_steps_per_batch=optim_steps_per_batch,
            add_gae=add_gae,
            gae=gae,
            done_key=done_key,
            **kwargs,
        )
        hook.register(self)


def _estimation(
    loss_module: LossModule, collector: BaseCollector
) -> Callable[[TensorDictBase], TensorDictBase]:
    """What estimates both advantages of the collector's batches."""
    # Then they are whole trajectories, one after the other, in a dimension without a name.
    joined = getattr(collector, "trajs_per_batch", None) and collector.traj_format == "cat"

    def estimate(batch: TensorDictBase) -> TensorDictBase:
        if joined:
            batch.names = ["time"]
        return loss_module.estimate_advantages(batch)

    return estimate


def _check_loss(loss_module: LossModule) -> None:
    loss_module = uncompiled(loss_module)
    if not isinstance(loss_module, CostCritic):
        raise TypeError(
            "loss_module must be an on-policy loss with a cost critic, such as PPOLagrangianLoss, "
            f"got {type(loss_module).__name__}."
        )
    if isinstance(loss_module, CUPLoss | TrustRegionLoss):
        raise ValueError(
            f"loss_module must be minimized as it stands, got {type(loss_module).__name__}: it "
            "needs a loop of its own (docs/algorithms.md)."
        )
