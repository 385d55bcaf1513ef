"""Hydra configurations beside TorchRL's own (``torchrl.trainers.algorithms.configs``).

Needs the ``hydra`` extra: ``pip install "torchrl-safe[hydra]"``. Nothing else imports this file.
After :func:`register_configs` the groups of TorchRL have these names too, and there is a group
``updater``:

=============================== ==============================================================
``env=arm``                     :class:`~torchrl_safe.envs.ArmEnv`
``loss=lagrangian``             :class:`~torchrl_safe.objectives.LagrangianLoss`, around the loss
                                of any other name of the group, at ``loss.loss_module``
``loss=crpo``                   :class:`~torchrl_safe.objectives.CRPOLoss`, the same
``updater=dual_ascent``         :class:`~torchrl_safe.objectives.DualAscent`
``updater=pid_control``         :class:`~torchrl_safe.objectives.PIDControl`
``updater=violation``           :class:`~torchrl_safe.objectives.ViolationUpdater`, for CRPO
``trainer=constrained_ppo``      :class:`~torchrl_safe.trainers.ConstrainedPPOTrainer`
=============================== ==============================================================
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from typing import Any

try:
    from hydra.core.config_store import ConfigStore
    from omegaconf import MISSING
except ImportError as error:
    raise ImportError(
        'torchrl_safe.trainers.configs needs Hydra: pip install "torchrl-safe[hydra]".'
    ) from error
from torch.distributions.transforms import Transform, identity_transform
from torchrl.objectives import LossModule

# What TorchRL's configurations are made with: it has no public way to add a trainer's.
from torchrl.trainers.algorithms.configs.common import ConfigBase, _normalize_hydra_key
from torchrl.trainers.algorithms.configs.envs_libs import EnvLibsConfig
from torchrl.trainers.algorithms.configs.objectives import LossConfig
from torchrl.trainers.algorithms.configs.trainers import (
    PPOTrainerConfig,
    _make_onpolicy_trainer,
)

from torchrl_safe.trainers.constrained_ppo import ConstrainedPPOTrainer


def _of(target: str, **arguments: Any) -> dict[str, Any]:
    return {"_target_": target, **arguments}


@dataclass
class ArmEnvConfig(EnvLibsConfig):
    """Configuration of :class:`~torchrl_safe.envs.ArmEnv`.

    An argument that is an object has a configuration here: ``obstacles._target_`` is
    ``torchrl_safe.envs.InFront`` by default, and the names beside it are arguments of that class.
    ``arm.path`` is the name of an arm.
    """

    arm: Any = field(
        default_factory=partial(_of, "hydra.utils.get_object", path="torchrl_safe.envs.PANDA")
    )
    num_envs: int = 1
    action: Any = field(default_factory=partial(_of, "torchrl_safe.envs.CartesianDelta"))
    task: Any = field(default_factory=partial(_of, "torchrl_safe.envs.Reach"))
    obstacles: Any = field(default_factory=partial(_of, "torchrl_safe.envs.InFront"))
    costs: Any = None
    observation: Any = field(default_factory=partial(_of, "torchrl_safe.envs.FullObservation"))
    frame_skip: int = 12
    max_episode_steps: int = 40
    scene: Any = field(default_factory=partial(_of, "torchrl_safe.envs.Scene"))
    physics: Any = field(default_factory=partial(_of, "torchrl_safe.envs.Bullet"))
    shield: Any = None
    seed: int | None = None
    device: Any = None
    gui: bool = False
    _convert_: str = "all"
    _target_: str = "torchrl_safe.envs.ArmEnv"


@dataclass
class WrappingLossConfig(LossConfig):
    """What the configurations of losses around a loss share."""

    loss_module: Any = MISSING
    cost_critic_network: Any = MISSING
    num_costs: int = 1
    cost_critic_coeff: float = 1.0
    separate_losses: bool = False
    _convert_: str = "all"


@dataclass
class LagrangianLossConfig(WrappingLossConfig):
    """Configuration of :class:`~torchrl_safe.objectives.LagrangianLoss`."""

    multiplier_init: Any = 0.0
    normalize_cost_advantage: bool = True
    _target_: str = "torchrl_safe.objectives.LagrangianLoss"


@dataclass
class CRPOLossConfig(WrappingLossConfig):
    """Configuration of :class:`~torchrl_safe.objectives.CRPOLoss`."""

    tolerance: Any = 0.0
    normalize_cost_advantage: bool = True
    _target_: str = "torchrl_safe.objectives.CRPOLoss"


@dataclass
class UpdaterConfig(ConfigBase):
    """What the configurations of updaters share: the trainer's loss is given to them later.

    With ``cost_names: [collision, speed]`` a limit goes by name,
    ``cost_limit: {collision: 0.5, speed: 2.0}``.
    """

    cost_limit: Any = MISSING
    pessimism: float = 0.0
    cost_names: Any = None
    _convert_: str = "all"
    _partial_: bool = True

    def __post_init__(self) -> None:
        """Nothing to prepare."""


@dataclass
class ViolationUpdaterConfig(UpdaterConfig):
    """Configuration of :class:`~torchrl_safe.objectives.ViolationUpdater`."""

    _target_: str = "torchrl_safe.objectives.ViolationUpdater"


@dataclass
class DualAscentConfig(UpdaterConfig):
    """Configuration of :class:`~torchrl_safe.objectives.DualAscent`."""

    lr: float = MISSING
    max_multiplier: float | None = None
    normalize: bool = False
    optimizer: Any = field(default_factory=partial(_of, "torch.optim.SGD", _partial_=True))
    # Without arguments, which another one would keep.
    parametrization: Any = field(
        default_factory=partial(_of, "torchrl_safe.trainers.configs._make_identity")
    )
    _target_: str = "torchrl_safe.objectives.DualAscent"


def _make_identity() -> Transform:
    """Returns the parametrization that leaves a multiplier as it is."""
    return identity_transform


@dataclass
class PIDControlConfig(UpdaterConfig):
    """Configuration of :class:`~torchrl_safe.objectives.PIDControl`."""

    kp: float = 0.5
    ki: float = 0.1
    kd: float = 0.0
    smoothing: float = 0.0
    max_multiplier: float | None = 20.0
    pessimism: float = 2.0
    normalize: bool = True
    _target_: str = "torchrl_safe.objectives.PIDControl"


@dataclass(kw_only=True)  # The parent has fields without a default behind these.
class ConstrainedPPOTrainerConfig(PPOTrainerConfig):
    """Configuration of :class:`~torchrl_safe.trainers.ConstrainedPPOTrainer`.

    Give the ``collector`` ``_partial_: true`` and no policy: it then gets the policy of the loss. A
    policy that is configured a second time would be another network.
    """

    updater: Any = MISSING
    optim_steps_per_batch: int | None = None
    gamma: float | None = None
    lmbda: float | None = None
    episode_cost_key: Any = "episode_cost"
    _target_: str = "torchrl_safe.trainers.configs.make_constrained_ppo_trainer"


def make_constrained_ppo_trainer(
    *,
    collector: Any,
    loss_module: LossModule,
    updater: Any,
    episode_cost_key: Any = "episode_cost",
    **settings: Any,
) -> ConstrainedPPOTrainer:
    """Makes a trainer of what Hydra has instantiated, as TorchRL's factories do.

    Args:
        collector (BaseCollector or partial): see :class:`ConstrainedPPOTrainerConfig`.
        loss_module (LossModule): the loss.
        updater (callable): called with the loss.
        episode_cost_key (NestedKey or list of str): see ``ConstrainedPPOTrainer``.
        **settings: the other fields of :class:`ConstrainedPPOTrainerConfig`.

    Raises:
        TypeError: if the updater is not callable, as one without ``_target_`` is not.
    """
    if not callable(updater):
        raise TypeError(
            "updater must name a rule, for example with 'updater@updater: pid_control' in the "
            f"defaults list, got {updater!r}."
        )
    if isinstance(collector, partial):
        own = {"policy", "policy_factory"} & {k for k, v in collector.keywords.items() if v}
        collector = collector() if own else collector(policy=loss_module.actor_network)
    make = partial(
        ConstrainedPPOTrainer,
        updater=updater(loss_module),
        episode_cost_key=_normalize_hydra_key(episode_cost_key),
    )
    return _make_onpolicy_trainer(make, collector=collector, loss_module=loss_module, **settings)


def register_configs() -> None:
    """Puts the configurations into Hydra's store. Call it before Hydra composes.

    Examples:
        >>> from hydra.core.config_store import ConfigStore
        >>> register_configs()
        >>> sorted(ConfigStore.instance().list("updater"))
        ['dual_ascent.yaml', 'pid_control.yaml', 'violation.yaml']
    """
    store = ConfigStore.instance().store
    store(group="env", name="arm", node=ArmEnvConfig)
    store(group="loss", name="lagrangian", node=LagrangianLossConfig)
    store(group="loss", name="crpo", node=CRPOLossConfig)
    store(group="updater", name="dual_ascent", node=DualAscentConfig)
    store(group="updater", name="pid_control", node=PIDControlConfig)
    store(group="updater", name="violation", node=ViolationUpdaterConfig)
    store(group="trainer", name="constrained_ppo", node=ConstrainedPPOTrainerConfig)
