import numpy as np
import pybullet
import pytest
from bullet_worlds import make_world
from worlds import Places, rest, step, turn

from torchrl_safe.envs import (
    ArmEnv,
    Box,
    Capsule,
    Cylinder,
    Look,
    NoObstacles,
    Part,
    Placement,
    Reach,
    Region,
    Sphere,
)
from torchrl_safe.envs.obstacles.shapes import footprint
from torchrl_safe.envs.physics.scene import Scene

SHAPES = {
    "cylinder": Cylinder(radius=0.03, height=0.16, mass=0.3),
    "box": Box((0.03, 0.04, 0.08), mass=0.3),
    "sphere": Sphere(0.05, mass=0.3),
    "capsule": Capsule(radius=0.03, length=0.1, mass=0.3),
}
each_shape = pytest.mark.parametrize("shape", SHAPES.values(), ids=SHAPES.keys())


def test_extents():
    """Half of the size along each axis, and the circle around it from above."""
    assert Cylinder(0.1, 0.4).half_extents == (0.1, 0.1, 0.2)
    assert footprint(Cylinder(0.1, 0.4)) == 0.1
    assert footprint(Box((0.3, 0.4, 0.1))) == pytest.approx(0.5)
    assert Sphere(0.2).half_extents == (0.2, 0.2, 0.2)
    assert footprint(Sphere(0.2)) == 0.2
    assert Capsule(0.1, 0.3).half_extents == (0.1, 0.1, 0.25)
    assert footprint(Capsule(0.1, 0.3)) == 0.1


@each_shape
def test_it_falls_and_comes_to_rest(make_env, shape):
    """On the table, as high as half its height, if it stands upright and not on a point."""
    height = shape.half_extents[2]
    env = make_env(
        ArmEnv, obstacles=Places(shape, at=[(0.6, 0.3, height + 0.02)]), seed=0, frame_skip=6
    )
    env.reset()
    rest(env)
    # After 0.025 s of free fall.
    np.testing.assert_allclose(env.arm_state.obstacle_velocity[0, 0], [0, 0, -0.245], atol=0.02)
    rest(env, 20)
    state = env.arm_state
    assert state.obstacle_position[0, 0, 2] == pytest.approx(height, abs=2e-3)
    np.testing.assert_allclose(state.obstacle_velocity[0, 0], 0, atol=0.01)
    np.testing.assert_allclose(state.obstacle_size, [shape.half_extents])


@each_shape
def test_it_can_be_knocked_over(make_env, shape):
    """The arm runs into its upper part; what it does is in the state."""
    height = shape.half_extents[2]
    top = 2 * height - 0.02
    task = Reach(Region((0.65, 0.2, 0.1), (0.65, 0.2, 0.1)))
    env = make_env(
        ArmEnv, task=task, obstacles=Places(shape, at=[(0.5, 0, height)]), max_episode_steps=200
    )
    env.reset()
    start, spins, turns, contact = env.arm_state.obstacle_position[0, 0], [], [], 0
    for _ in range(60):
        tool = env.arm_state.ee_position[0]
        goal = np.array([tool[0] if tool[2] > top + 0.03 else 0.7, 0, top])
        before = env.arm_state.obstacle_orientation[0, 0]
        contact += step(env, np.clip((goal - tool) / 0.05, -1, 1))["cost"].item()
        state = env.arm_state
        spins.append(state.obstacle_angular_velocity[0, 0])
        x = np.eye(3)
        turned = turn(state.obstacle_orientation[0, 0], x) - turn(before, x)
        turns.append(np.abs(turned).max())
    assert contact > 0
    np.testing.assert_allclose(np.linalg.norm(state.obstacle_orientation[0, 0]), 1, atol=1e-6)
    assert np.linalg.norm(state.obstacle_position[0, 0] - start) > 0.05
    spins = np.linalg.norm(spins, axis=1)
    # It turns when, and only when, it says so.
    assert spins.max() > 1
    assert max(turns) > 0.05
    assert spins[0] < 0.1
    assert turns[0] < 0.01
    if not isinstance(shape, Sphere):
        upright = turn(state.obstacle_orientation[0, 0], np.array([0, 0, 1.0]))[2]
        assert abs(upright) < 0.5, "it lies"


@each_shape
def test_angular_velocity_is_a_derivative(shape):
    """In free flight: the change of the axes is the cross product with the angular velocity."""

    world = make_world(scene=Scene(gravity=0.0), shapes=(shape,))
    try:
        world.reset(Placement([[0.6, 0.3, 0.5]]), np.zeros(3), np.zeros((0, 3)))

        body = world._obstacles[0]
        pybullet.resetBaseVelocity(
            body, (0.1, 0, 0), (1.0, 2.0, 0.5), physicsClientId=world._client
        )
        readings = []
        for _ in range(2):
            pybullet.stepSimulation(physicsClientId=world._client)
            readings.append((*world._obstacle_pose(0), *world._obstacle_velocity(0)))
    finally:
        world.close()
    (place, orientation, _, _), (place_later, later, velocity, spin) = readings
    np.testing.assert_allclose(np.subtract(place_later, place) * 240, velocity, atol=1e-4)
    axes = np.eye(3)
    change = (turn(later, axes) - turn(orientation, axes)) * 240
    np.testing.assert_allclose(change, np.cross(spin, turn(later, axes)), atol=0.05)


def test_fixed_shapes_stay(make_env):
    shapes = [Cylinder(), Box(), Sphere(), Capsule()]
    at = [(0.6, 0.3, 0.5), (0.6, -0.3, 0.5), (0.8, 0.3, 0.5), (0.8, -0.3, 0.5)]
    env = make_env(ArmEnv, obstacles=Places(*shapes, at=at), seed=0)
    env.reset()
    rest(env, 10)
    np.testing.assert_array_equal(env.arm_state.obstacle_position, [at])
    np.testing.assert_array_equal(env.arm_state.obstacle_velocity, np.zeros((1, 4, 3)))


def test_every_shape_is_drawn(make_env):
    """Each in the picture, and dark."""
    for shape in (Cylinder(0.08), Box(), Sphere(), Capsule(0.08)):
        layout = Places(shape, at=[(0.6, -0.2, 0.3)])
        env = make_env(ArmEnv, obstacles=layout, seed=0)
        empty = make_env(ArmEnv, obstacles=NoObstacles(), seed=0)
        env.reset(), empty.reset()
        pixels, without = (each.render(96, 72).int()[0] for each in (env, empty))
        changed = (pixels - without).abs().sum(-1) > 60
        dark = changed & (pixels.amax(-1) < 110)
        assert 20 < dark.sum() < 600
        assert changed.sum() < 2 * dark.sum() + 20


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Box((0.1, 0.1)), r"half_extents must have shape \(3,\), got \(2,\)"),
        (lambda: Box((0.1, 0.1, 0)), r"half_extents must be positive, got \(0.1, 0.1, 0\)"),
        (lambda: Box((0.1, 0.1, np.nan)), "half_extents must be finite"),
        (lambda: Box(mass=-1), "mass must be finite and not negative, got -1"),
        (lambda: Sphere(0), "radius must be positive and finite, got 0"),
        (lambda: Sphere(mass=np.nan), "mass must be finite and not negative, got nan"),
        (lambda: Capsule(radius=-1), "radius must be positive and finite, got -1"),
        (lambda: Capsule(length=0), "length must be positive and finite, got 0"),
        (lambda: Capsule(mass=np.inf), "mass must be finite and not negative, got inf"),
        (lambda: Cylinder(mass=np.nan), "mass must be finite and not negative, got nan"),
        (lambda: Part(Box(), (0, 0, 0), (1, 1, 1, 1)), "orientation must be a unit quaternion"),
    ],
)
def test_bad_arguments(make, message):
    with pytest.raises(ValueError, match=message):
        make()


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Part("x", (0, 0, 0)), "shape must be an instance of Cylinder or .* got 'x'"),
        (lambda: Look((1, 1, 1), parts=(3,)), "parts must be an instance of Part, got 3"),
    ],
)
def test_what_is_no_shape_is_refused_before_it_is_drawn(make, message):
    with pytest.raises(TypeError, match=message):
        make()


@pytest.mark.parametrize("kind", [Box, Capsule, Cylinder, Sphere])
def test_a_look_is_a_look(kind):
    with pytest.raises(TypeError, match="look must be an instance of Look, got 'red'"):
        kind(look="red")
