"""How figures and films look: names and colours of algorithms, the same everywhere."""

from __future__ import annotations

from typing import Any

import matplotlib as mpl
from matplotlib.axes import Axes

#: What is above a limit, and what touches.
ALARM = "#c1121f"
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


def limit_line(axis: Axes, limit: float, *, vertical: bool = False, text: str = "limit") -> None:
    """Draws a cost limit across an axis, with its name at the line, and shades what is above it."""
    line, span = (axis.axvline, axis.axvspan) if vertical else (axis.axhline, axis.axhspan)
    line(limit, color=INK, lw=1, ls=(0, (4, 3)), zorder=1)
    ends = axis.get_xlim() if vertical else axis.get_ylim()
    if ends[1] > limit:
        span(limit, ends[1], color=ALARM, alpha=0.05, lw=0, zorder=0)
        (axis.set_xlim if vertical else axis.set_ylim)(ends)
    where = {"xy": (limit, 1), "xycoords": ("data", "axes fraction"), "rotation": 90}
    if not vertical:
        where = {"xy": (1, limit), "xycoords": ("axes fraction", "data")}
    axis.annotate(
        text,
        **where,
        xytext=(2, -2) if vertical else (-2, 2),
        textcoords="offset points",
        ha="left" if vertical else "right",
        va="top" if vertical else "bottom",
        fontsize=8,
        color=INK,
    )
