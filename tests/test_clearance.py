"""How far the arm is from obstacles and how fast they approach, in the real simulator."""

import numpy as np
import pytest
import torch
from worlds import Places, at_speed, each_arm, home_of, rest, step

from torchrl_safe.envs import (
    PANDA,
    ArmEnv,
    Box,
    Collision,
    ContactForce,
    Cylinder,
    JointDelta,
    JointLimit,
    Moving,
    Proximity,
    Speed,
    SpeedAndSeparation,
    Sphere,
    Swing,
)

pytestmark = pytest.mark.usefixtures("engine")


def gap(angle, centre, radius):
    """Distance between the turntable's bar at an angle, rad, and a ball, m: a box and a point."""
    along = np.array([np.cos(angle), np.sin(angle), 0.0])
    across = np.array([-np.sin(angle), np.cos(angle), 0.0])
    local = np.subtract(centre, (0, 0, 0.5)) @ np.stack([along, across, np.array([0, 0, 1])], 1)
    outside = np.maximum(np.abs(local) - (0.5, 0.05, 0.02), 0)
    return np.linalg.norm(outside) - radius


@pytest.mark.parametrize(
    ("centre", "expected"),
    [
        ((0.8, 0.0, 0.5), 0.2),
        ((0.2, 0.3, 0.5), 0.15),
        # 0.3 m along, 0.4 m across: 0.5 m from the end.
        ((0.8, 0.45, 0.5), 0.4),
        ((0.0, 0.0, 0.82), 0.2),
        ((0.95, 0.45, 0.5), np.inf),
    ],
    ids=["end", "side", "corner", "above", "out-of-range"],
)
def test_clearance_is_a_distance_between_surfaces(make_env, turntable, centre, expected):
    turntable["obstacles"] = Places(Sphere(0.1), at=[centre])
    env = make_env(ArmEnv, **turntable, costs={"near": Proximity(margin=0.45)})
    env.reset()
    for cost in (None, rest(env)["cost"].item()):
        clearance = env.arm_state.trace["clearance"]
        np.testing.assert_allclose(clearance, np.full((1, 12, 1), expected), atol=5e-4)
        assert cost in (None, pytest.approx(max(0, 0.45 - expected), abs=5e-4))


def test_what_just_touches_is_at_a_distance_of_zero(make_env, turntable):
    """A box is put down on the bar, where exact numbers make it neither overlap nor hover."""

    def path(times):
        height = np.where(times > 0, 0.645, 0.7)
        way = np.stack([np.full_like(times, 0.25), np.zeros_like(times), height], -1)
        return way[:, None], np.tile([0.0, 0.0, 0.0, 1.0], (len(times), 1, 1))

    turntable["obstacles"] = Places(Box((0.125,) * 3), at=[(0.25, 0, 0.7)], path=path)
    env = make_env(ArmEnv, **turntable, costs={"near": Proximity(margin=0.9)})
    env.reset()
    rest(env)
    np.testing.assert_allclose(env.arm_state.trace["clearance"], 0, atol=5e-4)


def test_clearance_is_negative_where_they_overlap(make_env, turntable):
    """A ball goes 2 cm towards the end of the bar, and 2 cm into it."""
    start = (0.621, 0, 0.5)
    path = at_speed(start, (-0.4, 0, 0))
    turntable["obstacles"] = Places(Sphere(0.1), at=[start], path=path)
    env = make_env(ArmEnv, **turntable, costs={"apart": SpeedAndSeparation()})
    env.reset()
    clearances = []
    for _ in range(2):
        rest(env)
        clearances += env.arm_state.trace["clearance"][0, :, 0].tolist()
    np.testing.assert_allclose(clearances, 0.021 - 0.4 * np.arange(1, 25) / 240, atol=5e-4)


@pytest.mark.parametrize("gap", [0.015, 0.025])
def test_what_is_nearer_than_the_margin_counts_as_a_touch(make_env, turntable, gap):
    """Contacts begin a millimetre or two before a touch, so they cannot tell."""
    turntable["obstacles"] = Places(Sphere(0.1), at=[(0.6 + gap, 0, 0.5)])
    env = make_env(ArmEnv, **turntable, costs={"near": Collision(margin=0.02)})
    env.reset()
    assert rest(env)["cost"].item() == (gap < 0.02)


def test_what_is_only_measured_pushes_no_less(make_env):
    """A cylinder is driven into the hand, and moves the arm the same whatever is measured."""
    start = home_of(PANDA)

    def path(times):
        ways = np.outer(times, (-0.1, 0, 0))[:, None] + (start[0] + 0.15, start[1], 0.1)
        return ways, np.broadcast_to((0.0, 0, 0, 1), (len(times), 1, 4))

    rollouts = []
    for costs in (
        {},
        {"apart": SpeedAndSeparation(), "near": Proximity(margin=0.3)},
        {"near": Collision(margin=0.1), "limit": JointLimit(), "speed": Speed()},
    ):
        env = make_env(
            ArmEnv,
            action=JointDelta(),
            obstacles=Places(Cylinder(), at=path(np.zeros(1))[0][0], path=path),
            costs={"touch": Collision(), "force": ContactForce(), **costs},
            max_episode_steps=60,
            seed=0,
        )
        still = torch.zeros(1, 7)
        rollouts.append(env.rollout(60, lambda td: td.set("action", still))["next"])  # noqa: B023
    plain, *others = rollouts
    assert plain["cost"][..., 0].sum() > 10
    for other in others:
        assert torch.equal(other["observation"], plain["observation"])
        assert torch.equal(other["cost"][..., :2], plain["cost"])


def test_obstacles_that_are_absent_are_infinitely_far(make_env, turntable):
    places = Places(Sphere(0.1), Sphere(0.1), at=[(0.8, 0, 0.5)] * 2, present=[False, True])
    turntable["obstacles"] = places
    env = make_env(ArmEnv, **turntable, costs={"near": Proximity(margin=0.45)})
    env.reset()
    rest(env)
    clearance = env.arm_state.trace["clearance"][0, -1]
    np.testing.assert_allclose(clearance, [np.inf, 0.2], atol=1e-4)


def test_approach_of_the_arm_is_minus_the_change_of_clearance(make_env, turntable):
    """The bar turns towards a ball, and past it."""
    centre, radius = (0.62, 0.25, 0.5), 0.05
    turntable["obstacles"] = Places(Sphere(radius), at=[centre])
    costs = {"apart": SpeedAndSeparation(), "limit": JointLimit()}
    env = make_env(ArmEnv, **turntable, costs=costs)
    env.reset()
    angles, clearances, arm, obstacle = [], [], [], []
    for _ in range(14):
        step(env, 0.8)
        trace = env.arm_state.trace
        angles += trace["joint_position"][0, :, 0].tolist()
        clearances += trace["clearance"][0, :, 0].tolist()
        arm += trace["arm_approach"][0, :, 0].tolist()
        obstacle += trace["obstacle_approach"][0, :, 0].tolist()
    expected = [gap(angle, centre, radius) for angle in angles]
    np.testing.assert_allclose(clearances, expected, atol=1e-3)
    np.testing.assert_allclose(arm[1:], -np.diff(clearances) * 240, atol=0.03)
    assert min(arm) < -0.2
    assert max(arm) > 0.3
    np.testing.assert_allclose(obstacle, 0)


def test_approach_of_an_obstacle_is_minus_the_change_of_clearance(make_env, turntable):
    """A ball swings before the end of the bar, which holds still."""
    here = Places(Sphere(0.1), at=[(0.85, 0, 0.5)])
    turntable["obstacles"] = Moving(here, Swing(amplitude=0.2, period=1.0, direction=(1, 0, 0)))
    env = make_env(ArmEnv, **turntable, costs={"apart": SpeedAndSeparation()})
    env.reset()
    clearances, arm, obstacle, costs = [], [], [], []
    for _ in range(20):
        cost = rest(env)["cost"].item()
        trace = env.arm_state.trace
        clearances += trace["clearance"][0, :, 0].tolist()
        arm += trace["arm_approach"][0, :, 0].tolist()
        obstacle += trace["obstacle_approach"][0, :, 0].tolist()
        # By the definition: 0.3 s at the speed of the ball, and 0.05 m.
        needed = 0.05 + 0.3 * np.maximum(0, trace["obstacle_approach"])
        costs.append(cost == (trace["clearance"] < needed).any())
    assert all(costs)
    assert min(clearances) == pytest.approx(0.05, abs=2e-3)
    assert max(clearances) == pytest.approx(0.45, abs=2e-3)
    np.testing.assert_allclose(obstacle[1:], -np.diff(clearances) * 240, atol=1e-2)
    # 2 pi amplitude / period.
    assert max(obstacle) == pytest.approx(0.4 * np.pi, abs=0.01)
    np.testing.assert_allclose(arm, 0, atol=1e-3)


@each_arm
def test_approach_of_every_arm(make_env, arm):
    """Down towards a ball on the table."""
    ball = Places(Sphere(0.05), at=[np.add(home_of(arm), (0.02, 0.03, -0.15))])
    env = make_env(ArmEnv, arm, obstacles=ball, costs={"apart": SpeedAndSeparation()}, seed=0)
    env.reset()
    rows = []
    for _ in range(2):
        step(env, [0.3, 0, -0.5])
        trace = env.arm_state.trace
        rows += np.stack([trace[n][0, :, 0] for n in ("clearance", "arm_approach")], 1).tolist()
    clearance, approach = np.array(rows).T
    change = -np.diff(clearance) * 240
    assert change.max() > 0.1
    np.testing.assert_allclose(approach[1:], change, atol=0.03)
