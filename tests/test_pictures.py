"""TorchRL's films, and the gallery."""

import pytest
import torch
from PIL import Image
from torchrl.envs import Compose, TransformedEnv
from torchrl.record import PixelRenderTransform, VideoRecorder
from torchrl.record.loggers import CSVLogger

from experiments.gallery import Config, main
from torchrl_safe.envs import ArmEnv, Human

pytestmark = [pytest.mark.integration, pytest.mark.usefixtures("engine")]


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


def test_gallery(tmp_path, engine):
    main(Config(physics=engine, out=tmp_path / "new" / "gallery.png", width=100, steps=1))
    with Image.open(tmp_path / "new" / "gallery.png") as gallery:
        assert gallery.width >= 3 * 100
        assert len(gallery.convert("RGB").getcolors(10**6)) > 1000
