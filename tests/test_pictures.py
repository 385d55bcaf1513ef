"""Films and the contact sheet."""

import pytest
import torch
from PIL import Image
from torchrl.envs import Compose, TransformedEnv
from torchrl.envs.utils import RandomPolicy
from torchrl.record import PixelRenderTransform, VideoRecorder
from torchrl.record.loggers import CSVLogger

from experiments.gallery import Config, main
from experiments.report import save_animation
from torchrl_safe.envs import ArmEnv, Human

pytestmark = pytest.mark.usefixtures("engine")


def test_torchrl_films(make_env, tmp_path):
    recorder = VideoRecorder(CSVLogger("run", str(tmp_path), video_format="pt"), "film", skip=1)
    transforms = Compose(PixelRenderTransform(width=32, height=24), recorder)
    env = make_env(lambda: TransformedEnv(ArmEnv(obstacles=Human(), seed=0), transforms))
    pixels = env.rollout(5)["next", "pixels"]
    recorder.dump()
    (path,) = tmp_path.rglob("*.pt")
    film = torch.load(path)
    # One picture at the reset and one for each step, with the channels first.
    assert film.shape == (1, 6, 3, 24, 32)
    assert torch.equal(film[0, 1:], pixels[0].permute(0, 3, 1, 2))
    assert not torch.equal(film[0, 1], film[0, 5])


def test_animations_are_at_half_speed_whatever_the_control_rate(make_env, tmp_path):
    """GIF counts in hundredths of a second."""
    for rate, steps, frames in ((20, 3, 3), (240, 30, 4)):
        env = make_env(ArmEnv, frame_skip=240 // rate, max_episode_steps=steps, seed=0)
        save_animation(env, RandomPolicy(env.action_spec), tmp_path / "film.gif", episodes=1)
        with Image.open(tmp_path / "film.gif") as film:
            assert (film.n_frames, film.info["duration"]) == (frames, 100)


def test_contact_sheet(tmp_path):
    main(Config(arms=("Panda",), out=tmp_path / "new" / "sheet.png", width=40, steps=1))
    with Image.open(tmp_path / "new" / "sheet.png") as sheet:
        assert sheet.height > 0.9 * 15 * 30, "a row for each of 15 tasks and layouts"
        assert len(sheet.convert("RGB").getcolors(10**6)) > 1000
