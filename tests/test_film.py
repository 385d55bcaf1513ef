"""Films: what they show is what has happened."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image
from tensordict.nn import TensorDictModule
from torchrl.envs import Compose, RewardSum, TransformedEnv
from torchrl.envs.utils import RandomPolicy

from experiments.film import CAMERA, Pace, play, project, save_film, slow_motion
from torchrl_safe.envs import (
    ArmEnv,
    Camera,
    EarlyTermination,
    Human,
    JointDelta,
    Look,
    Part,
    Push,
    Shield,
    Sphere,
)
from torchrl_safe.envs.physics.palette import GOAL, OBSTACLE, TOUCHED

pytestmark = [pytest.mark.integration, pytest.mark.usefixtures("engine")]


def forwards(observation):
    """Straight ahead, through whatever is there."""
    return torch.tensor([1.0, 0.0, -0.3]).expand(*observation.shape[:-1], 3)


FORWARDS = TensorDictModule(forwards, in_keys=["observation"], out_keys=["action"])
TINY = (32, 24)
# With all of the table, and who sits at it.
WIDE = Camera(eye=(0.75, -1.5, 0.9), target=(0.5, 0.0, 0.24))


def share(picture, colour):
    """Share of the pixels of a colour's hue, however it is lit."""
    pixels = picture.astype(float) / np.maximum(picture.max(-1, keepdims=True), 1)
    wanted = np.array(colour[:3]) / max(colour[:3])
    return (np.abs(pixels - wanted).max(-1) < 0.12).mean()


def test_an_obstacle_lights_up_while_it_is_touched(make_env):
    env = make_env(ArmEnv, seed=0)
    tensordict, seen = env.reset(), {True: [], False: []}
    for _ in range(8):
        tensordict = env.step(FORWARDS(tensordict))["next"]
        picture = env.render(160, 120, CAMERA)[0].numpy()
        touches = tensordict["cost"].item() == 1
        seen[touches].append((share(picture, TOUCHED), share(picture, OBSTACLE)))
    assert seen[True]
    assert seen[False]
    assert all(red > 0.01 and red > dark for red, dark in seen[True])
    assert all(red < 0.001 and dark > 0.01 for red, dark in seen[False])


def test_a_person_is_only_drawn_as_one(make_env):
    """What belongs to the person beside arm and head collides with nothing."""

    class Plain(Human):
        @property
        def shapes(self):
            return tuple(replace(shape, look=None) for shape in super().shapes)

    finals, pictures = [], []
    for human in (Human(), Plain()):
        env = make_env(ArmEnv, obstacles=human, seed=0)
        final = env.rollout(10, FORWARDS, break_when_any_done=False)[..., -1]["next"]
        finals.append(final)
        pictures.append(env.render(160, 120, WIDE)[0].numpy())
    assert torch.equal(finals[0]["observation"], finals[1]["observation"])
    assert (pictures[0] != pictures[1]).any(-1).mean() > 0.05


def test_points_are_where_they_are_drawn(make_env):
    env = make_env(ArmEnv, seed=0)
    env.reset()
    camera, size = Camera(eye=(0.9, -0.8, 0.9), target=(0.5, 0.1, 0.1)), (320, 240)
    picture = env.render(*size, camera)[0].numpy()
    pixels = picture.astype(float) / picture.max(-1, keepdims=True)
    rows, columns = np.nonzero(np.abs(pixels - np.array(GOAL[:3]) / max(GOAL[:3])).max(-1) < 0.12)
    ((x, y),) = project(env.arm_state.goal, camera, size)
    # The ring is symmetric, up to perspective.
    assert (columns.min() + columns.max()) / 2 == pytest.approx(x, abs=3)
    assert (rows.min() + rows.max()) / 2 == pytest.approx(y, abs=4)


@pytest.mark.parametrize("action", [None, JointDelta(step=0.1)])
def test_slow_motion_is_the_same_episode(make_env, action):
    """Of a control step in four parts: the same way to within centimetres, the same cost."""
    settings = {"max_episode_steps": 6, **({} if action is None else {"action": action})}
    env = make_env(ArmEnv, seed=3, **settings)
    slow = make_env(slow_motion, env, 4)
    slow.set_seed(3)
    policy = FORWARDS if action is None else ones(7)
    whole = list(play(env, policy, Pace(), CAMERA, TINY))
    parts = list(play(slow, policy, Pace(parts=4), CAMERA, TINY))
    assert (len(whole), len(parts)) == (7, 25)
    assert parts[-1].cost == whole[-1].cost
    assert parts[-1].reward == pytest.approx(whole[-1].reward, rel=0.05)
    np.testing.assert_allclose(
        [moment.tool for moment in parts[::4]], [moment.tool for moment in whole], atol=0.04
    )


def ones(width):
    def act(observation):
        return torch.full((*observation.shape[:-1], width), 0.5)

    return TensorDictModule(act, in_keys=["observation"], out_keys=["action"])


def test_what_a_film_counts_is_what_the_environment_counts(make_env):
    env = make_env(ArmEnv, seed=0, max_episode_steps=10)
    sums = RewardSum(["reward", "cost"], ["episode_reward", "episode_cost"])
    summed = TransformedEnv(env, sums)
    last = list(play(summed, FORWARDS, Pace(), CAMERA, TINY))[-1]
    env.set_seed(0)
    episode = summed.rollout(10, FORWARDS)[..., -1]["next"]
    assert last.cost == {"collision": episode["episode_cost"].item()}
    assert last.cost["collision"] > 0
    assert last.reward == pytest.approx(episode["episode_reward"].item(), rel=1e-5)


def test_films_are_side_by_side_in_the_same_episodes(make_env, tmp_path):
    """At 40 pictures a simulated second, whatever the control rate, and still at the end."""
    for frame_skip, steps, pictures in ((12, 3, 7), (1, 24, 5)):
        actors = {
            name: (make_env(ArmEnv, frame_skip=frame_skip, max_episode_steps=steps), FORWARDS)
            for name in ("ppo", "mine")
        }
        save_film(actors, tmp_path / "film.gif", seed=1, episodes=1, width=40)
        with Image.open(tmp_path / "film.gif") as film:
            assert (film.n_frames, film.info["duration"]) == (pictures, 100)
            pixels = np.asarray(film.convert("RGB"), int)
        left, right = np.split(pixels[34:70, 4:-4], 2, axis=1)
        assert np.abs(left - right).mean() < 3


def test_what_cannot_be_divided_is_filmed_as_it_is(make_env, tmp_path):
    for env in (
        make_env(ArmEnv, shield=Shield(), max_episode_steps=4),
        make_env(
            lambda: TransformedEnv(
                ArmEnv(max_episode_steps=4),
                Compose(RewardSum(["cost"], ["episode_cost"]), EarlyTermination(budget=1.0)),
            )
        ),
        make_env(ArmEnv, task=Push(), max_episode_steps=41),
    ):
        policy = RandomPolicy(env.action_spec)
        save_film({"ppo": (env, policy)}, tmp_path / "film.webp", seed=0, episodes=1, width=32)
        assert not env.is_closed
        with Image.open(tmp_path / "film.webp") as film:
            assert film.n_frames > 3


def test_looks_are_checked():
    with pytest.raises(ValueError, match="colour must be three numbers from 0 to 1"):
        Look((0.5, 0.5, 2.0))
    with pytest.raises(ValueError, match="position must have shape"):
        Part(Sphere(), (0.0, 1.0))
