"""The figure and the animation of the arbitrary target study."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.animation import FuncAnimation, PillowWriter
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from ewif_jax.study.shared.figures import label, study_canvas

LOOK = (
    ("#00a5c8", "--", 1.3),
    ("#c800c8", "--", 1.3),
    ("#222222", "-", 1.3),
    ("#1b7837", "-", 1.6),
)
SHOWN = (20.0, 40.0)


def snapshot(example: Mapping[str, Any], names: Sequence[str]) -> Figure:
    """Fig. 2: part of the way, with measurements and the four tracks; and all of the truth."""
    figure, axes = study_canvas(1, 2, width=13, height=6, width_ratios=(3, 1))
    start, end = SHOWN
    arrived = (example["arrival"] >= start) & (example["arrival"] <= end)
    measured = (example["time"] >= start) & (example["time"] <= end)
    ax = axes[0]
    ax.plot(*example["truth"][arrived].T, color="#2166ac", linewidth=0.8, label="truth")
    for number, (marker, text) in enumerate((("+", "in sequence"), ("o", "late"))):
        some = example["measured"][measured & (example["sensor"] == number)]
        ax.plot(*some.T, marker, color="#888888", markersize=5, fillstyle="none", label=text)
    for name, (color, style, width) in zip(names, LOOK, strict=True):
        ax.plot(*example[name][arrived].T, style, color=color, linewidth=width, label=name)
    ax.set_aspect("equal", adjustable="datalim")
    ax.legend(frameon=False, fontsize="small")
    label(ax, "east [m]", "north [m]", f"From {start:g} s to {end:g} s")
    axes[1].plot(*example["truth"].T, color="#2166ac", linewidth=0.8)
    axes[1].plot(*example["truth"][arrived].T, color="#2166ac", linewidth=2.5)
    axes[1].set_aspect("equal", adjustable="datalim")
    label(axes[1], "east [m]", "north [m]", "The whole minute")
    return figure


def animation(
    example: Mapping[str, Any], names: Sequence[str], frames: int
) -> Callable[[Path], None]:
    """Writes a GIF of the target, what has arrived, and the newest estimates with their tails."""
    figure, ax = study_canvas(width=6.4, height=4.8)
    figure.set_layout_engine("none")
    FigureCanvasAgg(figure)
    moments = np.linspace(3.0, example["arrival"][-1], frames)

    def draw(moment: float) -> None:
        _draw_frame(ax, example, names, moment)

    def save(path: Path) -> None:
        FuncAnimation(figure, draw, frames=moments).save(path, PillowWriter(fps=8), dpi=70)

    return save


def _draw_frame(ax: Axes, example: Mapping[str, Any], names: Sequence[str], moment: float) -> None:
    ax.clear()
    ax.grid(alpha=0.25, linewidth=0.6)
    arrival = example["arrival"]
    tail = (arrival > moment - 6) & (arrival <= moment)
    here = example["truth"][tail][-1]
    ax.plot(*example["truth"].T, color="#2166ac", linewidth=0.5, alpha=0.4)
    ax.plot(*here, "*", color="#2166ac", markersize=11, label="truth")
    for number, marker in enumerate("+o"):
        some = example["measured"][tail & (example["sensor"] == number)]
        ax.plot(*some.T, marker, color="#888888", markersize=5, fillstyle="none")
    for name, (color, style, width) in zip(names, LOOK, strict=True):
        ax.plot(*example[name][tail].T, style, color=color, linewidth=width, label=name)
    ax.set_xlim(here[0] - 32, here[0] + 32)
    ax.set_ylim(here[1] - 24, here[1] + 24)
    ax.legend(loc="upper left", fontsize=7, frameon=False)
    label(ax, "east [m]", "north [m]", f"{moment:.1f} s: + in sequence, o late, by arrival")
