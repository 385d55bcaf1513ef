"""Films policies side by side and in slow motion, with reward, costs and limits.

``make train`` films its policies. ``python -m experiments.film_run`` films those of a run again.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.font_manager import FontProperties, findfont
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont
from tensordict import TensorDictBase
from torchrl.envs import Compose, EnvBase, RewardSum, TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type, step_mdp

from experiments.style import ALARM, INK, LIGHT, colour, label
from torchrl_safe.envs import ActionMode, ArmEnv, ArmState, Camera
from torchrl_safe.envs.physics.simulator import Simulator

Policy = Callable[[TensorDictBase], TensorDictBase]

#: From the side and close: tool, obstacle and goal fill the picture.
CAMERA = Camera(eye=(0.46, -1.0, 0.5), target=(0.46, 0.0, 0.2), field_of_view=42)
# Pictures of a simulated second, and the number after which no other episode begins. Twice as many
# with ``fine``.
_RATE, _MOST = 40, 80
# Milliseconds that a picture is shown, and the last one of an episode; the light of a touch stays
# for some pictures.
_SHOWN, _PAUSE, _GLOW = 100, 1500, 3
_HEAD, _FOOT, _GAP = 34, 58, 8
# Everything is drawn larger and then scaled down, so that lines and letters are smooth.
_SCALE = 2
_PER_ROW = 3


@dataclass(frozen=True)
class Pace:
    """How many pictures a control step has.

    Attributes:
        parts: steps of the environment in a control step of the policy, each with a picture.
        every: control steps in one picture, if the policy acts more often than is shown.
        repeats: how often each picture is shown, if the environment cannot be divided.
    """

    parts: int = 1
    every: int = 1
    repeats: int = 1


@dataclass(frozen=True)
class Moment:
    """One picture, and what has happened in the episode until then."""

    picture: NDArray[np.uint8]
    tool: tuple[float, float, float]
    touching: bool
    reward: float
    cost: dict[str, float]
    success: bool


def save_film(
    actors: Mapping[str, tuple[EnvBase, Policy]],
    path: Path,
    *,
    seed: int,
    limits: Mapping[str, float] | None = None,
    episodes: int = 2,
    width: int = 400,
    camera: Camera = CAMERA,
    fine: bool = False,
) -> None:
    """Films policies side by side, in the same episodes, at a quarter of their speed.

    An obstacle lights up while the arm touches it. Below each picture are the costs and the reward
    of the episode so far.

    Args:
        actors: environments of one world and policies, by the names of the algorithms.
        path: a file that ends in .gif or .webp.
        seed: seed of the episodes.
        limits: limits of the costs of an episode, by their names.
        episodes: how many; fewer if they are long.
        width: of each picture, in pixels.
        camera: where to look from.
        fine: draw twice as many pictures, with shadows, and in twice the size first. Takes ten
            times as long.
    """
    camera = replace(camera, shadows=fine or camera.shadows)
    scale = _SCALE if fine else 1
    size = (width * scale, width * 3 // 4 * scale)
    frames, durations, stages = [], [], []
    with ExitStack() as made:
        for name, (env, policy) in actors.items():
            stage, pace = _stage(env, 1 + fine)
            if stage is not env:
                made.callback(stage.close)
            stage.set_seed(seed)
            stages.append((name, stage, policy, pace))
        for _ in range(episodes):
            clips = {
                name: film(stage, policy, pace, camera, size)
                for name, stage, policy, pace in stages
            }
            for index in range(max(map(len, clips.values()))):
                panels = [
                    _panel(name, clip[: index + 1], limits or {}, width, camera, len(clip))
                    for name, clip in clips.items()
                ]
                frames.append(_in_rows(panels))
                durations.append(_SHOWN // (1 + fine))
            durations[-1] = _PAUSE
            if len(frames) >= _MOST * (1 + fine):
                break
    _save(frames, durations, path)


def film(
    env: EnvBase, policy: Policy, pace: Pace, camera: Camera, size: tuple[int, int]
) -> list[Moment]:
    """Films an episode of the deterministic policy, in pictures of equal distance in time."""
    moments = list(play(env, policy, pace, camera, size))
    return moments[:1] + [moment for moment in moments[1:] for _ in range(pace.repeats)]


@torch.no_grad()
def play(
    env: EnvBase, policy: Policy, pace: Pace, camera: Camera, size: tuple[int, int]
) -> Iterator[Moment]:
    """Plays an episode with the deterministic policy; yields what there is to see."""
    arm = _arm(env)
    steps = arm.max_episode_steps // pace.parts
    reward, costs, success = 0.0, dict.fromkeys(arm.cost_names, 0.0), False
    touching = False

    def moment() -> Moment:
        x, y, z = arm.arm_state.ee_position[0].tolist()
        picture = arm.render(*size, camera)[0].numpy()
        return Moment(picture, (x, y, z), touching, reward, dict(costs), success)

    tensordict = env.reset()
    yield moment()
    for step in range(1, steps + 1):
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            action = policy(tensordict)["action"]
        before, states = replace(arm.arm_state, previous=None), []
        for part in range(1, pace.parts + 1):
            tensordict = step_mdp(env.step(tensordict.set("action", action)))
            states.append(arm.arm_state)
            touching = bool(states[-1].touched[0].any())
            if part == pace.parts:
                whole = _whole(states, before)
                reward += float(arm.task.reward(whole)[0])
                for name, cost in arm.costs.items():
                    costs[name] += float(cost(whole)[0])
                success = bool(arm.task.success(whole)[0])
            if step % pace.every == 0 or success or step == steps:
                yield moment()
        if success:
            return


class Divided:
    """An action mode whose actions take several control steps, in equal parts.

    Args:
        whole: what an action does in all parts together.
        parts: how many. Repeat the action in each of them.
    """

    def __init__(self, whole: ActionMode, parts: int) -> None:
        self._whole, self._parts = whole, parts
        self.bound, self.moves_fingers, self.width = whole.bound, whole.moves_fingers, whole.width
        self._ends: list[tuple[NDArray[np.float64], NDArray[np.float64]]] = []

    def targets(
        self, action: NDArray[np.float64], state: ArmState, simulator: Simulator
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Returns the targets of the next part. All worlds are to be in the same one."""
        part = int(state.step[0]) % self._parts
        if part == 0:
            ends = self._whole.targets(action, state, simulator)
            starts = state.joint_position, state.finger_position[:, : ends[1].shape[1]]
            self._ends = list(zip(starts, ends, strict=True))
        share = (part + 1) / self._parts
        joints, fingers = (start + share * (end - start) for start, end in self._ends)
        return joints, fingers


def slow_motion(env: ArmEnv, parts: int) -> ArmEnv:
    """Returns an environment of one world in which a control step takes ``parts`` steps.

    Repeat each action ``parts`` times, and film in between.
    """
    return ArmEnv(
        env.arm,
        action=Divided(env.action_mode, parts),
        task=env.task,
        obstacles=env.obstacles,
        costs=env.costs,
        observation=env.observation,
        frame_skip=env.frame_skip // parts,
        max_episode_steps=env.max_episode_steps * parts,
        scene=env.scene,
        physics=env.physics,
    )


def _stage(env: EnvBase, times: int) -> tuple[EnvBase, Pace]:
    """What to film in: the environment in slow motion, if it can be divided, and its pace."""
    arm = _arm(env)
    rate, most = _RATE * times, _MOST * times
    wanted = max(1, min(round(rate / arm.control_rate), most // arm.max_episode_steps))
    every = max(1, round(arm.control_rate / rate))
    plain = env is arm or all(isinstance(each, RewardSum) for each in _transforms(env))
    # A shield plans for whole control steps.
    if wanted > 1 and plain and arm.shield is None and arm.frame_skip % wanted == 0:
        return slow_motion(arm, wanted), Pace(wanted)
    return env, Pace(every=every, repeats=wanted)


def base_env(env: EnvBase) -> EnvBase:
    """The environment without its transforms."""
    while isinstance(env, TransformedEnv):
        env = env.base_env
    return env


def check_film(name: str, path: Path) -> None:
    """Raises ValueError unless :func:`save_film` can write to a file of this name."""
    if path.suffix not in (".gif", ".webp"):
        raise ValueError(f"{name} must end in .gif or .webp, got {str(path)!r}.")


def _transforms(env: EnvBase) -> list[Any]:
    assert isinstance(env, TransformedEnv)
    return list(env.transform) if isinstance(env.transform, Compose) else [env.transform]


def _arm(env: EnvBase) -> ArmEnv:
    arm = base_env(env)
    assert isinstance(arm, ArmEnv)
    return arm


def _whole(states: Sequence[ArmState], before: ArmState) -> ArmState:
    """The state after a control step of which these are the parts."""
    last = states[-1]
    return replace(
        last,
        contact_distance=np.min([state.contact_distance for state in states], axis=0),
        contact_force=np.max([state.contact_force for state in states], axis=0),
        trace={
            name: np.concatenate([state.trace[name] for state in states], axis=1)
            for name in last.trace
        },
        previous=before,
    )


def _panel(
    name: str,
    clip: Sequence[Moment],
    limits: Mapping[str, float],
    width: int,
    camera: Camera,
    length: int,
) -> Image.Image:
    """Draws the last moment of the beginning of a clip of some length.

    The name of the algorithm is above, and what the episode has cost below.
    """
    now, scale, height = clip[-1], _SCALE, width * 3 // 4
    lines = len(now.cost) + 1
    full = (width * scale, (_HEAD + height + _FOOT * lines // 2) * scale)
    panel = Image.new("RGB", full, "white")
    picture = Image.fromarray(now.picture).resize(
        (width * scale, height * scale), Image.Resampling.BICUBIC
    )
    panel.paste(picture, (0, _HEAD * scale))
    draw = ImageDraw.Draw(panel)
    _draw_trail(draw, clip, colour(name), camera, (width * scale, height * scale), _HEAD * scale)
    draw.text((4 * scale, 5 * scale), label(name), colour(name), _font(19, bold=True))
    top, bottom = _HEAD * scale, (_HEAD + height) * scale
    if any(moment.touching for moment in clip[-_GLOW:]):
        draw.rectangle((0, top, full[0] - 1, bottom - 1), outline=ALARM, width=5 * scale)
        word = "COLLISION" if "collision" in now.cost else "CONTACT"
        _badge(draw, word, ALARM, (full[0] - 14 * scale, top + 14 * scale))
    above = any(cost > limits.get(key, math.inf) for key, cost in now.cost.items())
    if len(clip) == length:
        reached = "target reached" if now.success else "target missed"
        verdict = f"{reached}, over the limit" if above else reached
        good = now.success and not above
        _badge(
            draw, verdict, "#1a7f37" if good else ALARM, (full[0] - 14 * scale, bottom - 40 * scale)
        )
    line = bottom + 8 * scale
    for key, cost in now.cost.items():
        shown = "cost" if len(now.cost) == 1 else key
        _draw_cost(draw, shown, cost, limits.get(key), line, full[0])
        line += _FOOT // 2 * scale
    draw.text((4 * scale, line), f"reward {now.reward:.2f}".replace("-", "\u2212"), INK, _font(14))
    return panel


def _draw_trail(
    draw: ImageDraw.ImageDraw,
    clip: Sequence[Moment],
    hue: str,
    camera: Camera,
    size: tuple[int, int],
    top: int,
) -> None:
    points = project(np.array([moment.tool for moment in clip]), camera, size)
    points[:, 1] += top
    width = 3 * _SCALE
    for start, end, moment in zip(points[:-1], points[1:], clip[1:], strict=True):
        shade = ALARM if moment.touching else hue
        draw.line((*start, *end), shade, width + 2 * moment.touching * _SCALE)
        _dot(draw, end, width / 2, shade)


def _draw_cost(
    draw: ImageDraw.ImageDraw, name: str, cost: float, limit: float | None, y: int, right: int
) -> None:
    """A number, and a bar with a mark at the limit."""
    scale, over = _SCALE, limit is not None and cost > limit
    font, shade = _font(14, bold=True), ALARM if over else INK
    text = f"{name} {cost:g}" if float(cost).is_integer() else f"{name} {cost:.2f}"
    draw.text((4 * scale, y), text, shade, font)
    if limit is None:
        return
    after = 12 * scale + draw.textlength(text, font)
    draw.text((after, y + scale), f"limit {limit:g}", INK, _font(13))
    left, end, top = right // 2, right - 6 * scale, y + 2 * scale
    if after + draw.textlength(f"limit {limit:g}", _font(13)) > left - 8 * scale:
        return
    most = max(4.0 * limit, 1.0)
    draw.rectangle((left, top, end, top + 13 * scale), fill="#e3e7ec")
    if cost > 0:
        filled = left + (end - left) * min(cost / most, 1)
        draw.rectangle((left, top, filled, top + 13 * scale), fill=shade)
    mark = left + (end - left) * limit / most
    draw.line((mark, top - 3 * scale, mark, top + 16 * scale), INK, 2 * scale)


def _badge(draw: ImageDraw.ImageDraw, text: str, fill: str, corner: tuple[float, float]) -> None:
    """Writes white letters on a coloured ground, whose upper right corner is given."""
    font, pad = _font(15, bold=True), 6 * _SCALE
    x, y = corner[0] - draw.textlength(text, font) - 2 * pad, corner[1]
    draw.rounded_rectangle((x, y, corner[0], y + 26 * _SCALE), 4 * _SCALE, fill)
    draw.text((x + pad, y + 4 * _SCALE), text, "white", font)


def _dot(draw: ImageDraw.ImageDraw, centre: Any, radius: float, fill: str) -> None:
    x, y = centre
    draw.ellipse((x - radius, y - radius, x + radius, y + radius), fill)


@cache
def _font(size: int, *, bold: bool = False) -> ImageFont.FreeTypeFont:
    found = findfont(FontProperties(family="DejaVu Sans", weight="bold" if bold else "normal"))
    return ImageFont.truetype(found, size * _SCALE)


def _in_rows(panels: Sequence[Image.Image]) -> Image.Image:
    """Puts panels of one size side by side, in rows, and scales them down."""
    columns = min(len(panels), _PER_ROW)
    rows = math.ceil(len(panels) / columns)
    gap, (width, height) = _GAP * _SCALE, panels[0].size
    full = (columns * (width + gap) + gap, rows * (height + gap) + gap)
    sheet = Image.new("RGB", full, "white")
    for index, panel in enumerate(panels):
        row, column = divmod(index, columns)
        sheet.paste(panel, (gap + column * (width + gap), gap + row * (height + gap)))
    ImageDraw.Draw(sheet).rectangle((0, 0, full[0] - 1, full[1] - 1), outline=LIGHT, width=_SCALE)
    return sheet.resize((full[0] // _SCALE, full[1] // _SCALE), Image.Resampling.BOX)


def project(
    points: NDArray[np.float64], camera: Camera, size: tuple[int, int]
) -> NDArray[np.float64]:
    """Returns where points, m, ``(p, 3)``, are in a picture: pixels from the upper left corner."""
    eye = np.array(camera.eye)
    ahead = np.array(camera.target) - eye
    ahead /= np.linalg.norm(ahead)
    right = np.cross(ahead, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    seen = (points - eye) @ np.stack([right, -np.cross(right, ahead), ahead], axis=1)
    focal = size[1] / 2 / math.tan(math.radians(camera.field_of_view) / 2)
    return seen[:, :2] / seen[:, 2:] * focal + np.array(size) / 2


def _save(frames: Sequence[Image.Image], durations: Sequence[int], path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    options: dict[str, Any] = {"save_all": True, "duration": list(durations), "loop": 0}
    if path.suffix == ".gif":
        # One palette for all, so that what does not move takes no space.
        sample = Image.new("RGB", (frames[0].width, 4 * frames[0].height))
        for row, index in enumerate(np.linspace(0, len(frames) - 1, 4).astype(int).tolist()):
            sample.paste(frames[index], (0, row * frames[0].height))
        palette = sample.quantize(128)
        still = Image.Dither.NONE
        frames = [frame.quantize(palette=palette, dither=still) for frame in frames]
        options["optimize"] = False
    else:
        options |= {"quality": 80, "method": 4}
    frames[0].save(path, append_images=frames[1:], **options)
