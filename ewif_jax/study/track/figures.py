"""The figures of `ewif-jax track`."""

from typing import Any

import numpy as np
from matplotlib.figure import Figure

from ewif_jax.lab.plane import to_degrees
from ewif_jax.study.shared.figures import (
    EWIF,
    KALMAN,
    MEASURED,
    OTHER,
    TRUTH,
    label,
    legend_in_a_row,
    plain_ticks,
    study_canvas,
)
from ewif_jax.study.track.tracks import Tracks

MOST = 200
"""Tracks drawn at most."""


def track_maps(found: Tracks, estimate: dict[str, np.ndarray]) -> Figure:
    """All tracks, and the longest one with its measurements and two standard deviations."""
    figure, (left, right) = study_canvas(1, 2, width=11, height=4.8)
    longest = int(np.argmax(np.bincount(found.row)))
    for row in range(min(len(found.name), MOST)):
        place = _track_place(found, row, estimate["mean"])
        focus = row == longest
        left.plot(*place, color=KALMAN if focus else OTHER, linewidth=1.6 if focus else 0.7)
    name = found.name[longest]
    several = f"{len(found.name)} tracks; {name} highlighted"
    many = several if len(found.name) > 1 else "estimated track"
    dims = found.value.shape[-1]
    if found.origin is not None:
        latitude = np.deg2rad(found.origin[:, 0].mean())
        left.set_aspect(1 / np.cos(latitude))
        label(left, "longitude [deg]", "latitude [deg]", many)
    elif dims == 1:
        label(left, "time since start [s]", "x [m]", many)
    else:
        left.set_aspect("equal", adjustable="datalim")
        label(left, "x [m]", "y [m]", many)
    _draw_zoom(right, found, estimate, longest)
    return figure


def innovation_panels(found: Tracks, outcome: Any, counted: np.ndarray) -> Figure:
    """Prediction error and NIS of every scored measurement over time."""
    figure, (above, below) = study_canvas(2, 1, width=10, height=6.5, sharex=True)
    time = found.time
    runs = [("", outcome.after, EWIF, "-")]
    if outcome.history is not None:
        runs = [(", before tuning", outcome.before, KALMAN, "--"), (", tuned", *runs[0][1:])]
    for axes, key, statistic, word in (
        (above, "error", np.median, "median"),
        (below, "nis", np.mean, "mean"),
    ):
        good = counted & (outcome.after[key] > 0)
        points = outcome.after[key][good]
        size = 3 if points.size > 1000 else 6
        axes.semilogy(
            time[good], points, ".", markersize=size, color=MEASURED, label="one measurement"
        )
        axes.set_ylim(bottom=np.quantile(points, 0.01) / 2 if points.size else None)
        for text, run, color, style in runs:
            good = counted & np.isfinite(run[key])
            middle = _binned_statistic(time[good], run[key][good], statistic)
            axes.plot(*middle, style, color=color, linewidth=1.8, label=word + text)
        plain_ticks(axes)
    below.axhline(1, color=TRUTH, linewidth=0.8, label="expected mean")
    legend_in_a_row(above)
    legend_in_a_row(below)
    label(above, "", "one-step prediction error [m]")
    label(below, "time since the track's start [s]", "NIS per component")
    return figure


def outcome_histories(outcomes: list[Any], name: str, unit: str, loss: str) -> Figure:
    """Parameter and loss by evaluation."""
    figure, (left, right) = study_canvas(1, 2, width=10, height=4)
    for outcome, color in zip(outcomes, (EWIF, KALMAN), strict=False):
        text = f"{outcome.stamps} times: {outcome.value[1]:.3g} {unit}"
        left.semilogy(outcome.history["params"][name], color=color, label=text)
        right.plot(outcome.history["loss"], color=color)
    left.legend(frameon=False, fontsize="small")
    label(left, "evaluation", f"{name} [{unit}]")
    label(right, "evaluation", loss)
    plain_ticks(left)
    return figure


def _track_place(found: Tracks, row: int, mean: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    here = found.row == row
    if found.origin is not None:
        where = to_degrees(mean[here, :2], found.origin[row])
        return where[:, 1], where[:, 0]
    if found.value.shape[-1] == 1:
        return found.time[here], mean[here, 0]
    return mean[here, 0], mean[here, 1]


def _draw_zoom(axes: Any, found: Tracks, estimate: dict[str, np.ndarray], row: int) -> None:
    """Each axis of one track against time, less a straight line."""
    here = found.row == row
    time, value, seen = found.time[here], found.value[here], found.mask[here]
    mean, sd = estimate["mean"][here], estimate["sd"][here]
    for axis, color in zip(range(value.shape[1]), (EWIF, KALMAN, OTHER), strict=False):
        use = seen[:, axis]
        line = np.polyval(np.polyfit(time[use], value[use, axis], min(1, use.sum() - 1)), time)
        axes.plot(time[use], value[use, axis] - line[use], ".", color=color, alpha=0.5)
        axes.plot(time, mean[:, axis] - line, color=color, linewidth=1.3, label="xyz"[axis])
        low, high = (mean[:, axis] + s * 2 * sd[:, axis] - line for s in (-1, 1))
        axes.fill_between(time, low, high, color=color, alpha=0.15, linewidth=0)
    axes.legend(frameon=False, fontsize="small", title="estimate ± 2 sd, measurements")
    label(axes, "time since start [s]", "distance from a straight line [m]", found.name[row])


def _binned_statistic(
    time: np.ndarray, value: np.ndarray, statistic: Any
) -> tuple[np.ndarray, np.ndarray]:
    """A statistic in up to 25 bins of equal numbers."""
    order = np.array_split(np.argsort(time), max(min(25, len(time) // 8), 1))
    parts = [part for part in order if part.size]
    return (
        np.array([np.median(time[part]) for part in parts]),
        np.array([statistic(value[part]) for part in parts]),
    )
