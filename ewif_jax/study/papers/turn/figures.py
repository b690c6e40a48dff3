"""The figures of the study of the turn: 2-4 of the paper, and what accuracy costs."""

from collections.abc import Mapping

import numpy as np
from matplotlib.figure import Figure

from ewif_jax.scenarios.turn import LATE, PROMPT, turn_state
from ewif_jax.study.shared.experiment import Measured
from ewif_jax.study.shared.figures import (
    EWIF,
    KALMAN,
    MEASURED,
    OTHER,
    TRUTH,
    label,
    plain_ticks,
    study_canvas,
)
from ewif_jax.study.shared.late import DROPPED

LOOK = {
    "PFstd": (DROPPED, ":"),
    "PFord": ("#555555", "-."),
    "PFoosmEXT": (KALMAN, "-"),
    "PFoosmEKS": (OTHER, "-"),
    "PFoosmUKS": (EWIF, "--"),
    "PFoosmPS": ("#7b3294", "--"),
    "exact replay": (TRUTH, "-"),
}
BESIDE = {"EKF": ("#f4a582", ":"), "UKF": ("#92c5de", ":"), "EWIF": ("#66bd63", "-.")}
"""which the paper did not run to the end, or not at all"""
UNITS = {"position": "m", "velocity": "m/s"}


def turn_tracks(found: Mapping[str, Mapping[str, np.ndarray]]) -> Figure:
    """Fig. 2 and more: the path, the sensors, and how three filters follow the first run."""
    figure, axes = study_canvas(width=7, height=6.5)
    time = np.arange(31.0)
    axes.plot(*np.asarray(turn_state(np.linspace(0, 30, 200)))[:, :2].T, color=TRUTH, label="truth")
    axes.plot(*np.asarray(turn_state(time))[:, :2].T, ".", color=TRUTH, markersize=4)
    axes.plot(*np.asarray(PROMPT).T, "^", color=MEASURED, markersize=10, label="prompt sensors")
    axes.plot(*LATE, "v", color=DROPPED, markersize=10, label="late sensor")
    for name in ("PFstd", "PFoosmEKS", "PFord"):
        color, style = LOOK[name]
        axes.plot(*found[name]["track"][0].T, style, color=color, linewidth=1.3, label=name)
    axes.set_aspect("equal")
    axes.legend(frameon=False, fontsize="small", loc="lower left")
    label(axes, "x [m]", "y [m]", "30 s of the turn, clockwise from (-500, 500) m, one run")
    return figure


def rms_panel(
    found: Mapping[str, Mapping[str, np.ndarray]], bound: Mapping[str, np.ndarray], kind: str
) -> Figure:
    """Figs. 3 and 4: RMS error against time, with bounds."""
    figure, axes = study_canvas(width=11, height=5.5)
    time = np.arange(31.0)
    for name, (color, style) in (LOOK | BESIDE).items():
        if len(found[name][kind]) < len(found["PFstd"][kind]) and len(found[name][kind]) < 100:
            continue  # too few runs for a curve of its own
        mean = found[name][kind].mean(0)
        value = np.sqrt(mean)
        error = found[name][kind].std(0, ddof=1) / np.sqrt(len(found[name][kind])) / (2 * value)
        axes.plot(time, value, style, color=color, linewidth=1.4, label=name)
        axes.fill_between(time, value - error, value + error, color=color, alpha=0.15, linewidth=0)
    for begin, style, name in (
        ("", "-", "PCRLB without the late sensor, noisy motion"),
        ("late_", "--", "PCRLB with what has arrived, noisy motion"),
        ("parametric_", ":", "bound without the late sensor, steady turn"),
    ):
        axes.plot(
            time,
            np.sqrt(bound[begin + kind]),
            style,
            color=MEASURED,
            linewidth=3,
            label=name,
            zorder=0,
        )
    axes.set_yscale("log")
    plain_ticks(axes)
    figure.legend(frameon=False, fontsize="small", loc="outside right center")
    label(axes, "time [s]", f"RMS {kind} error [{UNITS[kind]}]", f"Error of the {kind}, ± 1 s.e.")
    return figure


def pareto_front(
    errors: Mapping[str, Measured],
    found: Mapping[str, Mapping[str, np.ndarray]],
    held: Mapping[str, int],
) -> Figure:
    """Error against time on one core; the area of a mark grows with the numbers stored."""
    figure, axes = study_canvas(width=9, height=5)
    costs = {name: found[name]["core_seconds"].mean() for name in LOOK}
    for name in sorted(LOOK, key=lambda name: costs[name]):
        color, (value, error) = LOOK[name][0], errors[name]
        axes.errorbar(costs[name], value, 2 * error, color=color, capsize=2, linewidth=1)
        area = 60 * held[name] / held["PFstd"]
        axes.scatter(
            costs[name],
            value,
            area,
            color=color,
            alpha=0.6,
            linewidth=0,
            label=f"{name}: {held[name]:,}",
        )
    axes.set_xscale("log")
    axes.legend(
        frameon=False,
        fontsize="small",
        title="numbers stored",
        loc="center left",
        bbox_to_anchor=(1, 0.5),
    )
    label(
        axes,
        "seconds per run on one core",
        "RMS position error [m]",
        "Error ± 2 s.e., time, and numbers stored (area)",
    )
    return figure
