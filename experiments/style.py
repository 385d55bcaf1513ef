"""How figures and films look: names and colours of algorithms, the same everywhere."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

#: What is above a limit, and what touches.
ALARM = "#c1121f"
_COST_TICKS = (0, 0.1, 0.3, 1, 3, 10, 30, 100, 300, 1000, 3000, 10_000, 30_000, 100_000)
INK, GREY, LIGHT = "#1b1f24", "#8b949e", "#d0d7de"

# Hues of Okabe and Ito, which readers who do not see all colours can tell apart. A family of
# algorithms shares a hue; shades differ in lightness.
_VERMILION, _ORANGE = "#d55e00", "#e69f00"
_BLUE, _SKY, _NAVY, _TEAL = "#0072b2", "#56b4e9", "#003f6b", "#2a9d8f"
_GREEN, _OLIVE, _FOREST = "#009e73", "#7a9a01", "#00563f"
_PURPLE, _PLUM, _ROSE = "#cc79a7", "#7b3a6b", "#e0a3c4"
_NAMES_AND_COLOURS: dict[str, tuple[str, str]] = {
    "ppo": ("PPO", _VERMILION),
    "trpo": ("TRPO", _ORANGE),
    "ppo-lagrangian": ("PPO-Lagrangian", _BLUE),
    "kl-ppo-lagrangian": ("KL-PPO-Lagrangian", _SKY),
    "a2c-lagrangian": ("A2C-Lagrangian", "#9ecae9"),
    "trpo-lagrangian": ("TRPO-Lagrangian", _NAVY),
    "sac-lagrangian": ("SAC-Lagrangian", _TEAL),
    "td3-lagrangian": ("TD3-Lagrangian", "#83c5be"),
    "cpo": ("CPO", _GREEN),
    "pcpo": ("PCPO", "#7fcdb3"),
    "focops": ("FOCOPS", _FOREST),
    "cup": ("CUP", _OLIVE),
    "p3o": ("P3O", _PURPLE),
    "ipo": ("IPO", _PLUM),
    "crpo": ("CRPO", _ROSE),
    "ppo-saute": ("PPO-Sauté", "#8c6d31"),
    "ppo-early-termination": ("PPO, early termination", "#bd9e39"),
    "ppo-shield": ("PPO with shield", INK),
    "ppo-lagrangian-shield": ("Lagrangian, shield", GREY),
}


def label(algorithm: str) -> str:
    """Returns the name of an algorithm as its authors write it."""
    return _NAMES_AND_COLOURS.get(algorithm, (algorithm, ""))[0]


def colour(algorithm: str) -> str:
    """Returns the colour of an algorithm; grey for one that is not known."""
    return _NAMES_AND_COLOURS.get(algorithm, ("", GREY))[1]


def figure_style() -> Any:
    """Returns a context in which Matplotlib draws in the style of this project."""
    return mpl.rc_context(
        {
            "font.size": 9,
            "axes.spines.top": False,
            "axes.spines.right": False,
            "axes.edgecolor": GREY,
            "axes.labelcolor": INK,
            "axes.titlelocation": "left",
            "axes.titlesize": 10,
            "axes.titleweight": "bold",
            "axes.grid": True,
            "grid.color": LIGHT,
            "grid.linewidth": 0.6,
            "xtick.color": INK,
            "ytick.color": INK,
            "legend.frameon": False,
            "savefig.dpi": 130,
            # On a dark page as well.
            "savefig.facecolor": "white",
        }
    )


def limit_line(
    axis: Axes, limit: float, *, vertical: bool = False, text: str = "limit", shade: bool = True
) -> None:
    """Draws a cost limit across an axis, named at its end, and shades what is above it."""
    line, span = (axis.axvline, axis.axvspan) if vertical else (axis.axhline, axis.axhspan)
    line(limit, color=INK, lw=1, ls=(0, (4, 3)), zorder=1)
    ends = axis.get_xlim() if vertical else axis.get_ylim()
    if shade and ends[1] > limit:
        span(limit, ends[1], color=ALARM, alpha=0.05, lw=0, zorder=0)
        (axis.set_xlim if vertical else axis.set_ylim)(ends)
    axis.annotate(
        text,
        (limit, 0) if vertical else (1, limit),
        xycoords=("data", "axes fraction") if vertical else ("axes fraction", "data"),
        rotation=90 if vertical else 0,
        xytext=(2, 3) if vertical else (-2, 2),
        textcoords="offset points",
        ha="left" if vertical else "right",
        va="bottom",
        fontsize=8,
        color=INK,
    )


def label_ends(axis: Axes, ends: Sequence[tuple[float, float, str, str]]) -> None:
    """Writes names where lines end, one above the other where they end close together.

    Args:
        axis: an axis whose limits do not change any more.
        ends: x, y, name and colour of each.
    """
    height = 9.5 / axis.get_window_extent().height * axis.figure.dpi / 72
    at = axis.transAxes.inverted()
    lowest = -float("inf")
    for x, y, name, hue in sorted(ends, key=lambda end: end[1]):
        right, up = at.transform(axis.transData.transform((x, y)))
        lowest = max(up, lowest + height)
        axis.annotate(
            name,
            (right, lowest),
            xycoords="axes fraction",
            xytext=(4, 0),
            textcoords="offset points",
            va="center",
            color=hue,
            fontweight="bold",
            annotation_clip=False,
        )


def cost_axis(axes: Axes, which: Literal["x", "y"], most: float) -> None:
    """Makes an axis logarithmic from 0.1 on, with 0 and with ticks that can be read."""
    ticks = [tick for tick in _COST_TICKS if tick <= 1.5 * most]
    scale = axes.set_xscale if which == "x" else axes.set_yscale
    scale("symlog", linthresh=0.1, linscale=0.6)
    axis = axes.xaxis if which == "x" else axes.yaxis
    axis.set_major_locator(FixedLocator(ticks))
    axis.set_minor_locator(NullLocator())
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
