"""The figures of the study of two bearing sensors: 1-15 of the paper, and one by delay."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from ewif_jax.scenarios.two_bearings import SENSORS
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
from ewif_jax.study.shared.late import rmse_of

LOOK = {
    "Fil-1 (sensor 1)": ("#b35806", ":"),
    "Fil-2 (sensor 2)": ("#e08214", ":"),
    "EKF (Al1)": (KALMAN, "-"),
    "RTS-based": (EWIF, "-"),
    "EnKF1": ("#7b3294", "--"),
    "EnKF2": (OTHER, "-"),
    "EnKF2, shared noise": ("#4aa3df", "--"),
    "PF": ("#555555", "-."),
    "PF, half as many": ("#999999", "-."),
    "EKF, late dropped": ("#fdb863", "--"),
    "EKF, exact replay": (TRUTH, "-"),
    "EWIF": ("#66bd63", "-."),
}
SHOWN = ("EKF (Al1)", "RTS-based", "EnKF1", "EnKF2", "EnKF2, shared noise", "PF")
Found = Mapping[str, Mapping[str, np.ndarray]]


def bearing_tracks(found: Found, truth: np.ndarray, at: int, delay: float) -> Figure:
    """Figs. 1, 6 and 11: the first run under delay number `at`, and how the filters follow it."""
    figure, axes = study_canvas(width=9, height=4.8)
    for name in ("Fil-1 (sensor 1)", "Fil-2 (sensor 2)", *SHOWN):
        color, style = LOOK[name]
        track = truth + found[name]["error"][at, 0]
        axes.plot(*track.T, style, color=color, linewidth=1.3, label=name)
    axes.plot(*truth.T, color=TRUTH, linewidth=2, label="truth", zorder=0)
    axes.plot(*np.asarray(SENSORS).T, "^", color=MEASURED, markersize=9, label="sensors")
    corners = np.concatenate([truth, SENSORS])
    (left, bottom), (right, top) = np.nanmin(corners, 0) - 100, np.nanmax(corners, 0) + 100
    axes.set(xlim=(left, right), ylim=(bottom, top))
    axes.set_aspect("equal")
    axes.legend(frameon=False, fontsize="small", ncols=2, loc="best")
    label(axes, "x [m]", "y [m]", f"One run, sensor 1 delayed by {delay:g} s")
    return figure


def bearing_errors(
    found: Found, bound: Mapping[str, np.ndarray], times: np.ndarray, at: int, delay: float
) -> Figure:
    """Figs. 2-5, 7-10 and 12-15: reported deviation and absolute error of x and of y, medians over
    the runs under delay number `at`."""
    figure, axes = study_canvas(2, 2, width=11, height=7.5, sharex=True, sharey="row")
    for column, axis in enumerate("xy"):
        for name in (*SHOWN, "EKF, exact replay"):
            color, style = LOOK[name]
            look: dict[str, Any] = {"linestyle": style, "color": color, "linewidth": 1.3}
            deviation = np.median(np.sqrt(found[name]["variance"][at, ..., column]), 0)
            error = np.median(np.abs(found[name]["error"][at, ..., column]), 0)
            axes[0, column].plot(times, deviation, **look, label=name if column == 0 else None)
            axes[1, column].plot(times, error, **look)
        for kind, style, name in (
            ("right", "-", "PCRLB"),
            ("published", ":", "PCRLB as published"),
        ):
            axes[0, column].plot(
                times,
                np.median(np.sqrt(bound[kind][at, ..., column]), 0),
                style,
                color=MEASURED,
                linewidth=3,
                zorder=0,
                label=name if column == 0 else None,
            )
        late = f"sensor 1 delayed by {delay:g} s, medians"
        label(axes[0, column], "", f"reported SD of {axis} [m]", f"Reported SD of {axis}, {late}")
        label(axes[1, column], "time [s]", f"|error of {axis}| [m]", f"Absolute error of {axis}")
    for row in axes:
        row[0].set_yscale("log")
    least = np.nanmin(np.median(np.sqrt(bound["right"][at]), 0)) / 10
    most = max(np.nanmax(line.get_ydata()) for one in axes[0] for line in one.lines) * 1.5
    axes[0, 0].set_ylim(max(axes[0, 0].get_ylim()[0], least), most)  # collapsed particles: below
    for row in axes:
        plain_ticks(row[0])
    figure.legend(frameon=False, fontsize="small", ncols=5, loc="outside upper center")
    return figure


def by_delay(
    squared: Mapping[str, np.ndarray],
    floor: np.ndarray,
    lost: Mapping[str, np.ndarray],
    delays: Sequence[float],
) -> Figure:
    """RMSE (a hollow mark where runs are lost) and median error of every filter by delay."""
    figure, axes = study_canvas(width=10, height=5)
    for k, (name, (color, _)) in enumerate(LOOK.items()):
        offset = (k - len(LOOK) / 2) * 0.075
        for place in range(len(delays)):
            value, error = rmse_of(squared[name][place])
            axes.errorbar(
                place + offset,
                value,
                2 * error,
                fmt="o",
                color=color,
                capsize=2,
                mfc="white" if lost[name][place].mean() > 0.02 else color,
                label=name if place == 0 else None,
            )
            median = np.sqrt(np.median(squared[name][place]))
            axes.plot(place + offset, median, "_", color=color, markersize=9)
    for place in range(len(delays)):
        axes.hlines(
            rmse_of(floor[place]).value,
            place - 0.45,
            place + 0.45,
            color=MEASURED,
            linewidth=2,
            zorder=0,
            label="PCRLB" if place == 0 else None,
        )
    axes.set_yscale("log")
    plain_ticks(axes)
    axes.set_xticks(range(len(delays)), [f"{delay:g} s" for delay in delays])
    figure.legend(frameon=False, fontsize="small", loc="outside right center")
    title = "± 2 s.e.; dash: median of the runs; hollow: more than 2 % of the runs are lost"
    label(axes, "delay of sensor 1", "RMSE [m]", title)
    return figure
