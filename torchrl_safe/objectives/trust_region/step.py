"""The step of the trust-region methods, in the place of ``optimizer.step()`` for the actor."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from functools import partial
from typing import Any, NamedTuple

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torch.distributions import Distribution
from torch.nn.parameter import is_lazy
from torchrl.modules import set_recurrent_mode
from torchrl.objectives import PPOLoss

from torchrl_safe._checks import check_kind
from torchrl_safe.objectives._checks import (
    SMALLEST,
    Checked,
    check_episode_length,
    check_fraction,
    check_length_known,
    check_number,
    check_whole,
    get_or_raise,
    uncompiled,
)
from torchrl_safe.objectives._reduction import reduced
from torchrl_safe.objectives.functional import penalized_advantage, per_step
from torchrl_safe.objectives.on_policy.policies import divergence
from torchrl_safe.objectives.trust_region.actor_copy import (
    ActorCopy,
    actor_parameters,
    importance_weight,
    in_precision,
)
from torchrl_safe.objectives.trust_region.loss import TrustRegionLoss
from torchrl_safe.objectives.trust_region.methods import (
    TRPO,
    TrustRegionMethod,
    TrustRegionProblem,
    TrustRegionSolution,
)
from torchrl_safe.objectives.trust_region.solver import (
    NotPositiveDefiniteError,
    backtracking_line_search,
    conjugate_gradient,
    fisher_vector_product,
    flat_gradient,
)


class _Evaluation(NamedTuple):
    distribution: Distribution
    loss: Tensor
    cost: Tensor


class _Batch(NamedTuple):
    """What is the same for every policy that is tried; the advantages have shape ``(*B, 1)``."""

    data: TensorDictBase
    advantage: Tensor
    cost_advantage: Tensor | None


class TrustRegionStep:
    r"""Moves the actor of a loss once for each collected batch, within a trust region.

    The gradients of the surrogates are solved by conjugate gradients against the Fisher matrix,
    ``method`` makes a step of them, and a line search shortens it until

    - the mean divergence from the policy before the step is at most ``max_kl``;
    - the reward surrogate has grown, if the step promises that and is no recovery;
    - under a constraint, the cost surrogate has grown by no more than the distance to the limit,
      or not at all above it

    (Achiam et al. 2017, https://arxiv.org/abs/1705.10528, section 6.1). If no length will do, or
    the damped Fisher matrix is found not to be positive definite, the parameters stay as they
    were, bit for bit, and ``rejected_steps`` or ``indefinite_steps`` counts it.
    Exactly at a limit, as before the first episode has ended, a step that raises the cost is
    rejected.

    The surrogates are means over steps, a limit is about whole episodes. So the loss's
    ``cost_violation`` is divided by the length of an episode before ``method`` gets it. This is
    the factor :math:`1 - \gamma` of the paper's equation 10.

    Args:
        loss_module (PPOLoss): :class:`~torchrl.objectives.PPOLoss` for TRPO alone, else a
            :class:`~torchrl_safe.objectives.TrustRegionLoss`. The actor must not share parameters
            with a critic: the step would move these too. The surrogate is the sum of its
            outputs ``"loss_objective"`` and, with an entropy bonus, ``"loss_entropy"``. (An entropy
            estimated from samples makes the line search noisy: better ``entropy_bonus=False``.)
        method (TrustRegionMethod, optional): :class:`~torchrl_safe.objectives.CPO`,
            :class:`~torchrl_safe.objectives.PCPO`, or by default
            :class:`~torchrl_safe.objectives.TRPO`, which with multipliers is TRPO-Lagrangian.

    Keyword Args:
        episode_length (float, optional): mean number of steps of an episode, to compare a
            surrogate, which is about one step, with a violation, which is about an episode.
            Defaults to ``1 / (1 - gamma)`` of the cost's value estimator.
        max_kl (float, optional): bound on the mean divergence of one step, in nats.
            Defaults to ``0.01``.
        damping (float, optional): multiple of the identity added to the Fisher matrix.
            Defaults to ``0.1``.
        cg_iterations (int, optional): iterations of conjugate gradients, which solve for the
            natural gradients. Defaults to ``10``.
        shrink (float, optional): the line search tries the fractions 1, ``shrink``,
            ``shrink**2`` ... of the step. Defaults to ``0.8``.
        max_backtracks (int, optional): how often it shortens the step. Defaults to ``10``.
        dtype (torch.dtype, optional): precision in which the step is found: a copy of the actor
            is differentiated, solved for and tried in it, whatever that of the actor is. Where
            the gradients of reward and cost are almost parallel, single precision changes the
            step of CPO by about 1e-3 from one processor to the next. Pass ``torch.float32`` for
            a network that fixes its own precision, or a device without another.
            Defaults to ``torch.float64``.

    Raises:
        ValueError: if the loss is of another kind, clipped or not averaged, has no trainable
            actor, or other costs than the one that ``method`` can limit, or multipliers that are
            not 0 beside a ``method`` that keeps the limit; or if a number is out of its range.

    The actor's distribution must have a divergence in closed form: normal, ``TanhNormal`` and
    categorical ones, and composites of them.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from tensordict.nn import TensorDictModule
        >>> from torchrl.modules import OneHotCategorical, ProbabilisticActor, ValueOperator
        >>> actor = ProbabilisticActor(
        ...     TensorDictModule(torch.nn.Linear(4, 3), ["observation"], ["logits"]),
        ...     in_keys=["logits"],
        ...     distribution_class=OneHotCategorical,
        ...     return_log_prob=True,
        ... )
        >>> critic = ValueOperator(torch.nn.Linear(4, 1), in_keys=["observation"])
        >>> loss = PPOLoss(actor, critic, entropy_bonus=False)
        >>> step = TrustRegionStep(loss, max_kl=0.01)
        >>> batch = TensorDict(observation=torch.randn(8, 4), batch_size=[8])
        >>> with torch.no_grad():
        ...     batch = actor(batch)
        >>> batch["advantage"], batch["value_target"] = torch.randn(8, 1), torch.randn(8, 1)
        >>> info = step.step(batch)
        >>> bool(info["kl"] <= 0.01), step.rejected_steps
        (True, 0)
    """

    episode_length = Checked(check_episode_length)
    max_kl = Checked(partial(check_number, least=SMALLEST))
    damping = Checked(check_number)
    cg_iterations = Checked(check_whole)
    shrink = Checked(partial(check_fraction, least=SMALLEST))
    max_backtracks = Checked(partial(check_whole, least=0))

    def __init__(
        self,
        loss_module: PPOLoss,
        method: TrustRegionMethod = TRPO(),
        *,
        episode_length: float | None = None,
        max_kl: float = 0.01,
        damping: float = 0.1,
        cg_iterations: int = 10,
        shrink: float = 0.8,
        max_backtracks: int = 10,
        dtype: torch.dtype = torch.float64,
    ) -> None:
        loss_module = uncompiled(loss_module)
        check_kind("method", method, TrustRegionMethod, such_as="TRPO()")
        _check_loss(loss_module, method)
        if not isinstance(dtype, torch.dtype) or not dtype.is_floating_point:
            raise ValueError(f"dtype must be a floating-point torch.dtype, got {dtype!r}.")
        self.loss_module = loss_module
        self.method = method
        self.episode_length = episode_length
        self.max_kl = max_kl
        self.damping = damping
        self.cg_iterations = cg_iterations
        self.shrink = shrink
        self.max_backtracks = max_backtracks
        self.dtype = dtype
        self.rejected_steps = 0
        self.indefinite_steps = 0
        self.recovery_steps = 0

    def step(self, tensordict: TensorDictBase) -> TensorDict:
        """Moves the actor once.

        Args:
            tensordict (TensorDictBase): the whole batch, collected by the present actor, with
                the advantages and value targets that ``estimate_advantages`` writes. Give the
                batch's episode costs to the updater of the loss before.

        Returns:
            Numbers to log, each of shape ``()``: ``kl``, ``surrogate_gain``,
            ``cost_surrogate_change`` (0 without a constraint), ``step_fraction`` that the line
            search let stand (0 if the actor has not moved), ``constraint_active``, and the counts
            ``rejected_steps``, ``indefinite_steps`` and ``recovery_steps``.

        Raises:
            KeyError: if an advantage is missing.
            ValueError: if the gradient of a surrogate is not finite, the length of an episode
                is not known, or multipliers are not 0 beside a method that keeps the limit;
                nothing has changed then.
            NotImplementedError: if the divergence of the policy has no closed form.
        """
        _check_multipliers(self.loss_module, self.method)
        batch = self._read(tensordict)
        actor = ActorCopy(self.loss_module, self.dtype)
        with torch.enable_grad(), set_recurrent_mode(True):
            start = self._evaluate(actor, batch)
            with torch.no_grad():
                fixed = actor.distribution(batch.data)
            try:
                problem = self._local_problem(actor, batch, start, fixed)
            except NotPositiveDefiniteError:
                self.indefinite_steps += 1
                return self._report()
            return self._search(actor, batch, start, fixed, problem, self.method(problem))

    def state_dict(self) -> dict[str, Any]:
        """Returns the counts, ``episode_length`` and ``max_kl``; the loss has the actor."""
        return {name: getattr(self, name) for name in _STATE}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Loads a state that :meth:`state_dict` returned."""
        state = {name: state_dict[name] for name in _STATE}
        for name, value in state.items():
            setattr(self, name, value)

    @torch.no_grad()
    def _read(self, tensordict: TensorDictBase) -> _Batch:
        loss, keys = self.loss_module, self.loss_module.tensor_keys
        needed = [keys.advantage]
        if isinstance(loss, TrustRegionLoss):
            needed.append(keys.cost_advantage)
        for key in needed:
            get_or_raise(tensordict, key)
        # Not the action: the inverse of a tanh is cut off where its precision ends.
        data = in_precision(tensordict, [*loss.actor_network.in_keys, *needed], self.dtype)
        # TorchRL's own options, then the multipliers; no public method has the result.
        advantage = loss._maybe_normalize_advantage(
            data.get(keys.advantage), data, update_norm=False
        )
        if isinstance(loss, TrustRegionLoss):
            advantage = penalized_advantage(
                advantage, data.get(keys.cost_advantage), loss.lagrange_multiplier
            )
        cost_advantage = data.get(keys.cost_advantage) if self.method.constrained else None
        for key, values in zip(needed, (advantage, cost_advantage), strict=False):
            if values is not None and values.shape[-1] != 1:
                raise ValueError(f"{key!r} must have shape (*B, 1), got {tuple(values.shape)}.")
        return _Batch(data, advantage, cost_advantage)

    def _evaluate(self, actor: ActorCopy, batch: _Batch) -> _Evaluation:
        shape = batch.advantage.shape[:-1]
        distribution = actor.distribution(batch.data)
        weight = importance_weight(self.loss_module, distribution, batch.data, shape)
        loss = -self._mean(weight * batch.advantage, batch)
        if self.loss_module.entropy_bonus:
            # TorchRL's, of any distribution; it has no public way to that of a given one.
            entropy = self.loss_module._get_entropy(distribution, shape)
            loss = loss + self._mean(self.loss_module._weighted_loss_entropy(entropy), batch)
        cost = torch.zeros_like(loss)
        if batch.cost_advantage is not None:
            cost = self._mean(weight * batch.cost_advantage, batch)
        return _Evaluation(distribution, loss, cost)

    def _mean(self, values: Tensor, batch: _Batch) -> Tensor:
        # As TorchRL reduces a loss, so that masked steps count nowhere.
        return reduced(self.loss_module, values, batch.data)

    def _mean_kl(self, fixed: Distribution, distribution: Distribution, batch: _Batch) -> Tensor:
        return self._mean(divergence(fixed, distribution, batch.advantage.shape[:-1]), batch)

    def _local_problem(
        self, actor: ActorCopy, batch: _Batch, start: _Evaluation, fixed: Distribution
    ) -> TrustRegionProblem:
        gradient = -_checked_gradient("reward", start.loss, actor)
        cost_gradient = torch.zeros_like(gradient)
        if self.method.constrained:
            cost_gradient = _checked_gradient("cost", start.cost, actor)
        product = fisher_vector_product(
            self._mean_kl(fixed, start.distribution, batch), actor.parameters, damping=self.damping
        )
        natural_gradient, natural_cost_gradient = (
            conjugate_gradient(product, vector, max_iterations=self.cg_iterations)
            for vector in (gradient, cost_gradient)
        )
        return TrustRegionProblem(
            gradient,
            natural_gradient,
            self.max_kl,
            cost_gradient,
            natural_cost_gradient,
            self._violation(),
            product,
        )

    def _violation(self) -> float:
        if not self.method.constrained:
            return 0.0
        loss = self.loss_module
        gamma = loss.cost_value_estimator.gamma
        check_length_known(self.episode_length, gamma)
        violation = float(per_step(self.episode_length, gamma)) * loss.cost_violation.item()
        # In the unit of the cost advantages.
        if loss.normalize_cost_advantage and loss.cost_advantage_scale > 0:
            violation /= loss.cost_advantage_scale.item()
        return violation

    @torch.no_grad()
    def _search(
        self,
        actor: ActorCopy,
        batch: _Batch,
        start: _Evaluation,
        fixed: Distribution,
        problem: TrustRegionProblem,
        solution: TrustRegionSolution,
    ) -> TensorDict:
        if not solution.step.any():  # Nothing to gain, and nothing to refuse.
            return self._report(constraint_active=solution.constraint_active)
        asks_gain = not solution.recovery and bool(problem.gradient @ solution.step > 0)
        measured: dict[str, Tensor] = {}

        def accepts(fraction: float) -> bool:
            actor.move(fraction * solution.step)
            trial = self._evaluate(actor, batch)
            kl = self._mean_kl(fixed, trial.distribution, batch)
            gain, rise = start.loss - trial.loss, trial.cost - start.cost
            measured.update(kl=kl, surrogate_gain=gain, cost_surrogate_change=rise)
            return bool(
                (kl <= self.max_kl)
                & (gain > 0 if asks_gain else gain.isfinite())
                & (rise <= max(-problem.violation, 0.0))
            )

        fraction = backtracking_line_search(
            accepts, shrink=self.shrink, max_backtracks=self.max_backtracks
        )
        if not fraction:
            self.rejected_steps += 1
            return self._report(constraint_active=solution.constraint_active)
        actor.commit()
        self.recovery_steps += solution.recovery
        return self._report(
            **measured, step_fraction=fraction, constraint_active=solution.constraint_active
        )

    def _report(self, **numbers: float | Tensor) -> TensorDict:
        counts = {name: getattr(self, name) for name in _COUNTS}
        numbers = {**dict.fromkeys(_NUMBERS, 0.0), **numbers}
        values = {name: torch.tensor(float(value)) for name, value in numbers.items()}
        return TensorDict({**values, **counts})


_NUMBERS = ("kl", "surrogate_gain", "cost_surrogate_change", "step_fraction", "constraint_active")
_COUNTS = ("rejected_steps", "indefinite_steps", "recovery_steps")
_STATE = (*_COUNTS, "episode_length", "max_kl")


def _checked_gradient(name: str, surrogate: Tensor, actor: ActorCopy) -> Tensor:
    # Reward, cost and divergence are those of one evaluation.
    gradient = flat_gradient(surrogate, actor.parameters, retain=True)
    if not gradient.isfinite().all():
        raise ValueError(
            f"The gradient of the {name} surrogate is not finite; the surrogate is "
            f"{surrogate.item()}. Look for NaN in the advantages, observations and actor."
        )
    return gradient


def _check_multipliers(loss: PPOLoss, method: TrustRegionMethod) -> None:
    if method.constrained and loss.lagrange_multiplier.any():
        raise ValueError(
            f"{method} keeps the cost limit itself: lagrange_multiplier of loss_module must be "
            f"0, or the cost counts twice, got {loss.lagrange_multiplier.tolist()}. Leave out the "
            "MultiplierUpdater and multiplier_init, or use TRPO with them."
        )


def _places(parameters: Iterable[Tensor]) -> set[int]:
    return {each.data_ptr() for each in parameters if not is_lazy(each)}


def _critic_parameters(loss: PPOLoss) -> Iterator[Tensor]:
    """Those of its critics, also shared ones, which ``separate_losses`` makes buffers."""
    critics = [loss.critic_network_params if loss.functional else loss.critic_network]
    if isinstance(loss, TrustRegionLoss):
        functional = loss.functional
        critics.append(loss.cost_critic_network_params if functional else loss.cost_critic_network)
    for critic in critics:
        if critic is not None:
            yield from critic.parameters()
            yield from critic.buffers()


def _check_loss(loss: PPOLoss, method: TrustRegionMethod) -> None:
    # No other subclass: the step has the surrogate of these two, whatever another's forward does.
    if type(loss) is not PPOLoss and not isinstance(loss, TrustRegionLoss):
        raise ValueError(
            "loss_module must be a PPOLoss without clipping or penalty, or a TrustRegionLoss, got "
            f"{type(loss).__name__}."
        )
    if loss.reduction != "mean":
        raise ValueError(f"loss_module must have reduction='mean', got {loss.reduction!r}.")
    if not (moved := actor_parameters(loss)):
        raise ValueError("The actor of loss_module has no trainable parameter.")
    if _places(moved) & _places(_critic_parameters(loss)):
        raise ValueError(
            "The actor of loss_module must not share parameters with a critic: a step would move "
            "these too."
        )
    if not method.constrained:
        return
    if not isinstance(loss, TrustRegionLoss):
        raise ValueError(
            f"{method} needs a TrustRegionLoss, which has a cost critic, got {type(loss).__name__}."
        )
    if loss.num_costs != 1:
        raise ValueError(
            f"{method} limits one cost, in closed form, but loss_module has "
            f"{loss.num_costs}. Add them up, or use TRPO with multipliers."
        )
    _check_multipliers(loss, method)
