"""Arguments of all kinds: either they work, or an error names the argument.

``pytest -m slow tests/test_fuzz.py --hypothesis-show-statistics`` tries many more.
"""

import inspect
import math

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings, strategies as st
from tensordict import TensorDict
from torchrl.envs.utils import check_env_specs
from torchrl.objectives import ClipPPOLoss, LossModule, SoftUpdate

from torchrl_safe import envs, metrics, objectives
from torchrl_safe.envs import ArmEnv
from torchrl_safe.testing import make_batch, make_networks, make_q_networks, make_transitions

# ---------------------------------------------------------------- values

NUMBERS = st.one_of(
    st.sampled_from([0, 1, 2, 0.02, 0.05, 0.1, 0.5, 1.0]),
    st.integers(-2, 6),
    st.floats(-2, 2),
    st.floats(allow_nan=True, allow_infinity=True),
)
POINTS = st.tuples(*[st.floats(-1, 1)] * 3)
ROWS = st.lists(NUMBERS, max_size=4).map(tuple)
ODD = st.sampled_from(
    [None, True, "text", b"", {}, set(), object(), int, len, 1j, np.float32(0.5), np.zeros((2, 2)),
     torch.tensor(0.5), torch.zeros(3), torch.zeros(2, 2), -0.0, 10**400, [], ("a", "b", "c")]
)  # fmt: skip
PARTS = st.sampled_from(
    [envs.Box(), envs.Cylinder(mass=0.1), envs.Sphere(0.03), envs.Capsule(), envs.Swing(),
     envs.Patrol(), envs.InFront(), envs.Scattered(1), envs.NoObstacles(), envs.Human(),
     envs.Region((0.3, -0.4, 0.0), (0.7, 0.4, 0.2)), envs.Reach(), envs.Push(), envs.Collision(),
     envs.JointDelta(), envs.Scene(), envs.Bullet(), envs.Camera(), envs.PANDA, envs.Sensing()]
)  # fmt: skip
ANYTHING = st.one_of(NUMBERS, NUMBERS, POINTS, ROWS, ODD, PARTS)


def parameters_of(function):
    """The parameters; TorchRL's metaclass hides those of an environment."""
    made = ArmEnv.__init__ if function is ArmEnv else function
    named = inspect.signature(made).parameters.items()
    return {name: p for name, p in named if name != "self" and p.kind is not p.VAR_KEYWORD}


@st.composite
def arguments(draw, function, only=None):
    """Some arguments of a function, and always those that it needs."""
    chosen = {}
    for name, parameter in parameters_of(function).items():
        needed = parameter.default is parameter.empty
        if only is not None and name not in only:
            continue
        if needed or draw(st.integers(0, 2)) == 0:
            chosen[name] = draw(ANYTHING)
    return chosen


def attempt(function, chosen, *more):
    """What a function returns, or None if it has refused an argument by its name."""
    try:
        return function(*more, **chosen)
    except (TypeError, ValueError) as error:
        check_named(error, parameters_of(function), f"{function.__name__} {chosen}")
        return None


def check_named(error, names, source):
    """The message of an error names one of these."""
    if not any(name in str(error) for name in names):
        raise AssertionError(f"no argument is named: {source}") from error


def run(check, strategy, examples, few):
    """Checks what is drawn: the same few examples each time, or many new ones."""
    settings(
        max_examples=examples,
        derandomize=examples == few,
        deadline=None,
        database=None,
        suppress_health_check=list(HealthCheck),
    )(given(strategy)(check))()


def fuzz(strategy, *, few, many):
    """Makes a check of one drawn value two tests, a quick and a slow one."""

    def double(check):
        @pytest.mark.parametrize("examples", [few, pytest.param(many, marks=pytest.mark.slow)])
        def test(examples):
            run(check, strategy, examples, few)

        test.__doc__ = check.__doc__
        return test

    return double


def calls(*functions, only=None):
    """Pairs of a function and arguments for it."""
    return st.sampled_from(functions).flatmap(
        lambda function: arguments(function, only).map(lambda chosen: (function, chosen))
    )


# ---------------------------------------------------------------- the parts of an environment

ACTIONS = (envs.CartesianDelta, envs.JointDelta)
TASKS = (envs.Reach, envs.Push, envs.PickAndPlace)
LAYOUTS = (envs.InFront, envs.Scattered, envs.Moving, envs.Human)
COSTS = (
    envs.Collision, envs.ContactForce, envs.Proximity, envs.JointLimit, envs.Speed,
    envs.SpeedAndSeparation, envs.Workspace,
)  # fmt: skip
OTHERS = (
    envs.Scene, envs.Bullet, envs.Camera, envs.Region, envs.Box, envs.Cylinder, envs.Sphere,
    envs.Capsule, envs.Swing, envs.Patrol, envs.Sensing, envs.Placement, envs.Gripper,
    envs.ArmModel, envs.DampedLeastSquares,
)  # fmt: skip


@fuzz(calls(*ACTIONS, *TASKS, *LAYOUTS, *COSTS, *OTHERS), few=300, many=50_000)
def test_parts(call):
    """What can be made has a repr; a layout or task places things, or names what prevents it."""
    kind, chosen = call
    part = attempt(kind, chosen)
    if part is None:
        return
    assert kind.__name__ in repr(part)
    rng, start, goal = np.random.default_rng(0), np.array([0.35, 0, 0.2]), np.array([0.65, 0, 0.1])
    try:
        if kind in LAYOUTS:
            placement = part.sample(rng, start, goal)
            assert len(placement.position) == len(part.shapes)
            assert np.isfinite(placement.at(np.array([0.0, 0.3]))[0]).all()
        if kind in TASKS:
            goal, objects = part.sample(rng, envs.PANDA.goals)
            assert goal.shape == (3,)
            assert objects.shape == (len(part.objects), 3)
    except ValueError as error:
        check_named(error, parameters_of(kind), part)


@st.composite
def environments(draw):
    """Arguments of an ArmEnv: parts that could be made, and now and then anything."""
    chosen = {}
    for name, kinds in {"action": ACTIONS, "task": TASKS, "obstacles": LAYOUTS}.items():
        if draw(st.booleans()):
            kind, settings = draw(calls(*kinds))
            part = attempt(kind, settings)
            chosen |= {} if part is None else {name: part}
    if draw(st.booleans()):
        made = [attempt(*draw(calls(*COSTS))) for _ in range(draw(st.integers(1, 3)))]
        chosen["costs"] = {str(index): cost for index, cost in enumerate(made) if cost}
    chosen |= {name: value for name, value in draw(arguments(ArmEnv)).items() if draw(RARELY)}
    # Not to be tried: hours of substeps, thousands of worlds, a window, other machines' devices.
    for name in ("num_envs", "frame_skip"):
        if isinstance(chosen.get(name), int) and chosen[name] > 3:
            del chosen[name]
    return {**chosen, "gui": False, "device": None}


RARELY = st.integers(0, 5).map(lambda number: number == 0)


@fuzz(environments(), few=2, many=300)
def test_environments(chosen):
    """An environment that can be made keeps to its specs."""
    # Regions that are too small for what is drawn in them show when it is drawn.
    names = ("region", "gap", "obstacles", "task")
    try:
        env = attempt(ArmEnv, chosen)
    except AssertionError as error:
        check_named(error.__cause__, names, chosen)
        return
    if env is None:
        return
    try:
        check_env_specs(env)
        assert env.rollout(3)["next", "observation"].isfinite().all()
    except ValueError as error:
        check_named(error, names, chosen)
    finally:
        env.close()


# ---------------------------------------------------------------- actions

DTYPES = [torch.float32, torch.float64, torch.float16, torch.int64, torch.bool, torch.complex64]
SHAPES = st.one_of(st.just((2, 3)), st.lists(st.integers(0, 3), max_size=3).map(tuple))


@st.composite
def actions(draw):
    shape, dtype = draw(SHAPES), draw(st.sampled_from(DTYPES))
    numbers = st.one_of(st.floats(-2, 2), st.floats(width=32))
    values = draw(st.lists(numbers, min_size=math.prod(shape), max_size=math.prod(shape)))
    return (
        torch.tensor(values, dtype=torch.float64)
        .nan_to_num(nan=math.nan if dtype.is_floating_point else 0.0)
        .reshape(shape)
        .to(dtype)
    )


@pytest.fixture(scope="module")
def arm():
    env = ArmEnv(num_envs=2, seed=0)
    yield env
    env.close()


@pytest.mark.parametrize("examples", [40, pytest.param(5_000, marks=pytest.mark.slow)])
def test_actions(examples, arm):
    """Any tensor moves the arms to where the specs hold, or is refused as an action."""

    def check(action):
        arm.reset()
        try:
            result = arm.step(TensorDict({"action": action}, batch_size=[2]))["next"]
        except (RuntimeError, TypeError, ValueError) as error:
            check_named(error, ("action", "batch dimension"), action)
            return
        assert arm.observation_spec.is_in(result.select("observation", "success"))
        assert result["observation"].isfinite().all()
        assert result["reward"].isfinite().all()

    run(check, actions(), examples, few=40)


# ---------------------------------------------------------------- objectives

OURS = {
    "num_costs", "multiplier_init", "cost_critic_coeff", "temperature", "kl_bound",
    "penalty_coeff", "sharpness", "tolerance", "separate_losses", "episode_length",
}  # fmt: skip


def of_networks(kind):
    def make(**chosen):
        return kind(*make_networks(), entropy_bonus=False, **chosen)

    return named(make, kind)


def around_ppo(kind):
    def make(**chosen):
        actor, critic, cost_critic = make_networks()
        return kind(ClipPPOLoss(actor, critic, entropy_bonus=False), cost_critic, **chosen)

    return named(make, kind)


def named(make, kind):
    make.__signature__ = inspect.signature(kind)
    make.__name__ = kind.__name__
    return make


LOSSES = [
    of_networks(kind)
    for kind in (
        objectives.PPOLagrangianLoss, objectives.FOCOPSLoss, objectives.CUPLoss,
        objectives.P3OLoss, objectives.IPOLoss, objectives.TrustRegionLoss,
    )
] + [around_ppo(objectives.LagrangianLoss), around_ppo(objectives.CRPOLoss)]  # fmt: skip


@fuzz(calls(*LOSSES, only=OURS), few=60, many=10_000)
def test_losses(call):
    """A loss that can be made gives finite losses for a batch, or says how wide costs must be."""
    make, chosen = call
    loss = attempt(make, chosen)
    if loss is None:
        return
    batch = make_batch()
    if chosen.get("num_costs", 1) != 1:
        with pytest.raises(ValueError, match=r"num_costs|cost_advantage"):
            loss(loss.estimate_advantages(batch).reshape(-1))
        return
    losses = loss(loss.estimate_advantages(batch).reshape(-1))
    for key, value in losses.items():
        assert value.isfinite().all() or not key.startswith("loss_"), key


def of_q_networks(kind, **options):
    def make(**chosen):
        deterministic = kind is objectives.TD3LagrangianLoss
        loss = kind(*make_q_networks(deterministic=deterministic), **options, **chosen)
        SoftUpdate(loss, tau=0.5)
        return loss

    return named(make, kind)


Q_LOSSES = [
    of_q_networks(objectives.SACLagrangianLoss, target_entropy=-2.0),
    of_q_networks(objectives.TD3LagrangianLoss, bounds=(-1.0, 1.0)),
]


@fuzz(calls(*Q_LOSSES, only={"num_cost_qvalue_nets", "multiplier_init"}), few=40, many=2_000)
def test_q_losses(call):
    """An off-policy loss that can be made gives finite losses."""
    loss = attempt(*call)
    if loss is None:
        return
    for key, value in loss(make_transitions()).items():
        assert value.isfinite().all() or not key.startswith("loss_"), key


def updating(kind):
    def make(**chosen):
        module = LossModule()
        for name in ("lagrange_multiplier", "cost_violation"):
            module.register_buffer(name, torch.ones(2))
        return kind(module, **chosen)

    return named(make, kind)


UPDATERS = [
    updating(kind)
    for kind in (
        objectives.DualAscent,
        objectives.PIDControl,
        objectives.ViolationUpdater,
    )
]
RULE = {
    "cost_limit", "lr", "kp", "ki", "kd", "smoothing", "max_multiplier", "pessimism", "normalize",
}  # fmt: skip
EPISODES = st.one_of(
    st.lists(st.tuples(st.floats(0, 1e6), st.floats(0, 1e6)), max_size=5).map(
        lambda rows: torch.tensor(rows).reshape(-1, 2)
    ),
    st.lists(st.tuples(NUMBERS, NUMBERS), max_size=3).map(lambda r: torch.tensor(r).reshape(-1, 2)),
    ODD.filter(lambda value: isinstance(value, torch.Tensor)),
)


@fuzz(st.tuples(calls(*UPDATERS, only=RULE), st.lists(EPISODES, max_size=3)), few=200, many=50_000)
def test_updaters(drawn):
    """Multipliers are finite and not negative after whatever costs; refused ones change nothing."""
    (make, chosen), batches = drawn
    updater = attempt(make, chosen)
    if updater is None:
        return
    buffer = getattr(updater.loss_module, updater.buffer_name)
    for episode_cost in batches:
        before = buffer.clone()
        try:
            updater.step(episode_cost)
        except ValueError as error:
            check_named(error, ("episode_cost", "next_multiplier"), (updater, episode_cost))
            assert torch.equal(buffer, before)
        assert buffer.isfinite().all()
        assert (buffer >= 0).all() or updater.buffer_name == "cost_violation"


# ---------------------------------------------------------------- budgets and metrics


BUDGET = {"budget", "unsafe_reward", "termination_reward", "discount"}


@fuzz(calls(envs.Saute, envs.EarlyTermination, only=BUDGET), few=60, many=10_000)
def test_budgets(call):
    """A budget that can be made is kept in an environment with as many costs."""
    transform = attempt(*call)
    if transform is None:
        return
    costs = transform.budget.numel() if transform.budget.ndim else 1
    if not costs:
        return
    tally = torch.full((2, costs), transform.start)
    for _ in range(3):
        tally = transform.advance(tally, torch.rand(2, costs))
        assert transform.is_spent(tally).shape == (2, costs)
        assert not tally.isnan().any()


TENSORS = st.one_of(
    st.lists(st.integers(0, 3), max_size=4).map(lambda shape: torch.ones(shape)),
    st.lists(st.integers(1, 3), min_size=2, max_size=3).map(lambda shape: torch.rand(shape) > 0.5),
    st.lists(NUMBERS.map(float), min_size=1, max_size=6).map(lambda r: torch.tensor(r)[:, None]),
)
RESULTS = {"Estimate", "WorstSeed"}
FIGURES = [getattr(metrics, name) for name in metrics.__all__ if name not in RESULTS]


@st.composite
def figures(draw):
    function = draw(st.sampled_from(FIGURES))
    chosen = draw(arguments(function))
    for name in ("true", "episode_cost", "cost", "mean_cost", "done"):
        if name in chosen:
            chosen[name] = draw(TENSORS)
    return function, chosen


@fuzz(figures(), few=150, many=20_000)
def test_metrics(call):
    """Figures are numbers, and an interval is around its estimate."""
    result = attempt(*call)
    if result is None:
        return
    for tensor in result if isinstance(result, tuple) else [result]:
        assert not tensor.isnan().any(), call
