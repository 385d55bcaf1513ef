"""What ArmEnv draws, and the cameras it is seen by."""

import numpy as np
import pytest
import torch
from torchrl.envs import TransformedEnv
from torchrl.record import PixelRenderTransform
from worlds import Places, step

from torchrl_safe.envs import (
    ArmEnv,
    Box,
    Bullet,
    Camera,
    MuJoCo,
    NoObstacles,
    Reach,
    Region,
    Sphere,
)

both_engines = pytest.mark.usefixtures("engine")


def test_render(make_env):
    env = make_env(ArmEnv, num_envs=2, seed=0)
    env.reset()
    pixels = env.render(width=96, height=64)
    assert pixels.shape == (2, 64, 96, 3)
    assert pixels.dtype == torch.uint8
    red, green, blue = pixels.int().unbind(-1)
    dark = (red < 80) & (green < 90) & (blue > red + 5)
    assert dark.flatten(1).sum(1).min() > 20, "the obstacle is in the picture"
    assert not torch.equal(pixels[0], pixels[1]), "each world has its own goal"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"eye": (1, 2)}, r"eye must have shape \(3,\), got \(2,\)"),
        ({"eye": (0, 0, 1), "target": (0, 0, 1)}, "eye must not be where it looks"),
        ({"field_of_view": 0}, "field_of_view must be positive and finite, got 0"),
        ({"field_of_view": 180}, "field_of_view must be less than 180, got 180"),
    ],
)
def test_camera_rejects(arguments, message):
    with pytest.raises(ValueError, match=message):
        Camera(**arguments)


@pytest.mark.parametrize("eye", [(0.4, 0.0, 1.5), (12.0, 0.0, 4.0)], ids=["down", "far"])
@pytest.mark.parametrize("physics", [Bullet(), MuJoCo(threads=1)], ids=["bullet", "mujoco"])
def test_a_camera_may_look_straight_down_and_from_afar(make_env, eye, physics):
    env = make_env(ArmEnv, physics=physics)
    env.reset()
    picture = env.render(64, 48, Camera(eye=eye, target=(0.4, 0.0, 0.0)))[0]
    assert len(picture.reshape(-1, 3).unique(dim=0)) > 1  # Not the background alone.


@pytest.mark.parametrize("physics", [Bullet(), MuJoCo(threads=1)], ids=["bullet", "mujoco"])
def test_shadows_are_dark(make_env, physics):
    env = make_env(ArmEnv, physics=physics, seed=0)
    env.reset()
    without, with_shadows = (
        env.render(64, 48, Camera(shadows=shadows)).float().mean() for shadows in (False, True)
    )
    assert with_shadows < without - 1


def test_render_wants_a_camera(make_env):
    env = make_env(ArmEnv)
    with pytest.raises(TypeError, match="camera must be an instance of Camera, got 'above'"):
        env.render(camera="above")


def test_pixels_in_a_rollout(make_env):
    """TorchRL's transform makes an observation of what render() draws."""
    transform = PixelRenderTransform(width=32, height=24)
    env = make_env(lambda: TransformedEnv(ArmEnv(num_envs=2, seed=0), transform))
    pixels = env.rollout(2)["next", "pixels"]
    assert pixels.shape == (2, 2, 24, 32, 3)
    assert pixels.float().std() > 10


@both_engines
def test_pictures_show_the_arm_and_the_target(make_env):
    env = make_env(ArmEnv, num_envs=2, obstacles=NoObstacles(), seed=0)

    def targets(pixels):
        """Where the green marker of each world is: row and column."""
        red, green, blue = pixels.int().unbind(-1)
        marked = (green > red + 50) & (green > blue + 20)
        assert marked.flatten(1).any(1).all(), "the target is in the picture"
        return [picture.nonzero().float().mean(0) for picture in marked]

    env.reset()
    before = env.render(width=96, height=96)
    one, two = targets(before)
    assert (one - two).abs().max() > 2, "each world has its own target"
    wide = env.render(width=192, height=96)
    shown = wide[:, :, 48:144].int() - before.int()
    assert shown.abs().max() < 10, "more width shows more, at the same scale"
    for _ in range(10):
        step(env, torch.tensor([[1.0, 1, 1], [0, 0, 0]]))
    changed = (env.render(width=96, height=96).int() - before.int()).abs().sum(-1) > 60
    assert changed[0].sum() > 200
    assert changed[1].sum() < 20


@both_engines
@pytest.mark.parametrize("field_of_view", [45.0, 22.5])
def test_where_a_camera_shows_the_target(make_env, field_of_view):
    """From above, x is up and y to the left; how far from the middle, by hand."""
    goal = (0.6, 0.2, 0.1)
    env = make_env(ArmEnv, task=Reach(Region(goal, goal)), obstacles=NoObstacles(), seed=0)
    env.reset()
    camera = Camera((0.5, 0.1, 1.5), (0.5, 0.1, 0.0), field_of_view)
    red, green, blue = env.render(160, 120, camera)[0].int().unbind(-1)
    marked = ((green > red + 50) & (green > blue + 20)).nonzero() + 0.5
    # 0.1 m of the 1.4 m tan(fov / 2) between the middle and the edge.
    apart = 60 * 0.1 / (1.4 * np.tan(np.radians(field_of_view / 2)))
    np.testing.assert_allclose(marked.mean(0), [60 - apart, 80 - apart], atol=1)


@both_engines
def test_obstacles_are_drawn_as_they_are_turned(make_env):
    """A bar along y, by a quarter of a turn along x, which is up in the picture from above."""
    quarter = [[0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5)]]
    layout = Places(Box((0.02, 0.15, 0.02)), at=[(0.6, 0.3, 0.1)], orientation=quarter)
    env = make_env(ArmEnv, obstacles=layout, seed=0)
    env.reset()
    camera = Camera((0.6, 0.3, 1.0), (0.6, 0.3, 0.0))
    red, green, blue = env.render(80, 80, camera)[0, 20:60, 20:60].int().unbind(-1)
    dark = ((red < 80) & (green < 90) & (blue > red + 5)).nonzero().float()
    height, width = dark.std(0)
    assert height > 3 * width


@both_engines
def test_only_what_is_touched_lights_up(make_env, turntable):
    """Each world for itself: the bar turns into the ball in the first, and rests in the second."""
    turntable["obstacles"] = Places(Sphere(0.1), at=[(0.45, 0.16, 0.5)])
    env = make_env(ArmEnv, **turntable, num_envs=2)
    env.reset()
    cost = step(env, [[1.0], [0.0]])["cost"]
    assert cost.flatten().tolist() == [1, 0]
    red, green, blue = env.render(80, 60).int().unbind(-1)
    lit = ((red > 3 * green) & (red > 3 * blue)).sum((1, 2))
    assert lit[0] > 20
    assert lit[1] == 0
