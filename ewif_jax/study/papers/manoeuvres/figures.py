"""The figures of the study of manoeuvres."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from ewif_jax.study.papers.manoeuvres import runs as runs_of
from ewif_jax.study.papers.manoeuvres.runs import EWIF as BY_WEIGHT
from ewif_jax.study.papers.manoeuvres.runs import IMM, KALMAN
from ewif_jax.study.shared.figures import EWIF, MEASURED, OTHER, TRUTH, label, study_canvas
from ewif_jax.study.shared.figures import KALMAN as PINK

LOOK = {BY_WEIGHT: EWIF, KALMAN: PINK, IMM: OTHER}


def errors(rows: Sequence[Mapping[str, Any]]) -> Figure:
    """RMSE of every filter on every target, late data used or dropped, +- 2 standard errors."""
    targets = list(dict.fromkeys(row["target"] for row in rows))
    figure, axes = study_canvas(1, len(targets), width=5 * len(targets), height=4)
    for ax, target in zip(axes, targets, strict=True):
        for name, color in LOOK.items():
            for marker, use in (("o", "used"), ("x", "dropped")):
                one = next(
                    row["RMSE [m]"]
                    for row in rows
                    if (row["target"], row["late data"], row["filter"]) == (target, use, name)
                )
                place = list(LOOK).index(name) + (0.12 if use == "dropped" else -0.12)
                ax.errorbar(place, one.value, 2 * one.error, fmt=marker, color=color, capsize=3)
        ax.set_xticks(range(len(LOOK)), list(LOOK))
        ax.set_ylim(0)
        label(ax, "", "RMSE of the position [m] ± 2 s.e.", target)
    for marker, use in (("o", "late data used"), ("x", "late data dropped")):
        axes[0].plot([], [], marker, color=TRUTH, label=use)
    axes[0].legend(frameon=False, fontsize="small", loc="lower left")
    return figure


def modes(example: Mapping[str, np.ndarray]) -> Figure:
    """One run of the arrowhead: how hard it turns, and what the mixture thinks of it."""
    figure, axes = study_canvas(2, 1, width=9, height=6, sharex=True)
    time, truth = example["time"], example["truth"]
    turning = axes[0].twinx()
    axes[0].plot(time, example["busy"], color=OTHER, label="probability of the busy mode")
    turning.plot(time, runs_of.path_acceleration(time), color=TRUTH, linewidth=0.9)
    turning.set_ylabel("acceleration of the target [m/s²]")
    axes[0].yaxis.label.set_color(OTHER)
    axes[0].set_ylim(0, 1)
    label(
        axes[0], "", "probability of the busy mode", "Arrowhead, a measurement 5 s late on average"
    )
    for name, color in LOOK.items():
        off = np.linalg.norm(example[name] - truth, axis=1)
        axes[1].plot(time, off, color=color, linewidth=1.1, label=name)
    seen = np.linalg.norm(example["seen"] - truth, axis=1)
    axes[1].plot(time, seen, ".", color=MEASURED, markersize=2, label="measurements")
    axes[1].set_ylim(0, np.quantile(seen, 0.9))
    axes[1].legend(frameon=False, fontsize="small", ncols=4)
    label(axes[1], "time [s]", "distance from the truth [m]")
    return figure
