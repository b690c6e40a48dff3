"""Pictures of what a filter made of a series."""

import jax.numpy as jnp
import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Ellipse

from ewif_jax import checks
from ewif_jax.analysis.consistency import chi2_band, nees, nis
from ewif_jax.lab import style
from ewif_jax.lab.style import ESTIMATE, TRUTH
from ewif_jax.types import Measurement, Numbers, Status, Trace

ELLIPSES = 12
"""how many covariance ellipses a track shows"""


def track(
    trace: Trace,
    truth: Numbers = None,
    measurements: Measurement | None = None,
    *,
    axes: tuple[int, int] = (0, 1),
    probability: float = 0.95,
    factor: float = 1.0,
    ax: Axes | None = None,
) -> Axes:
    """The path of two state components with covariance ellipses, the truth, and the measurements,
    late ones coloured by what became of them.

    Args:
        trace: of `run`, one series.
        truth: (T, k), its first components like those of the state.
        measurements: (T, ...) whose first two components are these positions.
        axes: which two components of the state.
        probability: that an ellipse holds the truth, if the covariance is honest.
        factor: by which standard deviations are multiplied (`calibrated_factor`): the covariance
            of an EWIF is not that of its error.
        ax: to draw on.
    """
    mean, cov = _check_single(trace)
    ax = style.own_axes(ax, 6.5, 6.0)
    x, y = axes
    if measurements is not None:
        seen = np.all(np.asarray(measurements.mask)[:, :2], axis=1)
        value = np.where(seen[:, None], np.asarray(measurements.value)[:, :2], np.nan)
        _by_status(ax, value[:, 0], value[:, 1], np.asarray(trace.info.status))
    if truth is not None:
        true = np.asarray(truth)
        ax.plot(true[:, x], true[:, y], color=TRUTH, linewidth=1.2, label="truth")
    ax.plot(mean[:, x], mean[:, y], color=ESTIMATE, linewidth=1.5, label="estimate")
    radius = factor * np.sqrt(-2 * np.log1p(-probability))
    places = np.unique(np.linspace(0, len(mean) - 1, ELLIPSES).astype(int))
    for k in places[np.isfinite(mean[places]).all(1)]:
        values, vectors = np.linalg.eigh(cov[k][np.ix_(axes, axes)])
        width, height = 2 * radius * np.sqrt(np.maximum(values, 0))
        angle = np.degrees(np.arctan2(vectors[1, 0], vectors[0, 0]))
        place = (float(mean[k, x]), float(mean[k, y]))
        ax.add_patch(Ellipse(place, width, height, angle=angle, color=ESTIMATE, alpha=0.2, lw=0))
    scaled = "" if factor == 1 else f", standard deviations times {factor:.2g}"
    ax.plot(
        [], [], color=ESTIMATE, alpha=0.3, linewidth=8, label=f"{probability:.0%} ellipse{scaled}"
    )
    ax.set_aspect("equal", adjustable="box")
    style.label(ax, f"component {x}", f"component {y}")
    style.legend_above(ax)
    return ax


def component(
    trace: Trace,
    index: int,
    truth: Numbers = None,
    measurements: Measurement | None = None,
    *,
    deviations: float = 2.0,
    factor: float | None = None,
    band_cov: Numbers = None,
    name: str | None = None,
    ax: Axes | None = None,
) -> Axes:
    """A state component against time with a band of some standard deviations, the truth, and what
    was measured of it. The legend says where the band comes from.

    Args:
        trace: of `run`, one series.
        index: which component.
        truth: (T, k) with that component, or (T,).
        measurements: (T, ...) whose component `index` it is, if any.
        deviations: half the width of the band in standard deviations.
        factor: by which the filter's standard deviations are multiplied (`calibrated_factor`).
        band_cov: (n, n) or (T, n, n) in place of the filter's covariance, for instance of
            `actual_error`: the covariance of an EWIF is not that of its error.
        name: of the component, with its unit.
        ax: to draw on.
    """
    mean, cov = _check_single(trace)
    ax = style.own_axes(ax)
    time = np.asarray(trace.time)
    source = "covariance of the filter"
    if band_cov is not None:
        cov, source = np.broadcast_to(np.asarray(band_cov), cov.shape), "computed actual error"
    spread = deviations * np.sqrt(np.maximum(cov[:, index, index], 0)) * (factor or 1.0)
    if factor is not None:
        source += f" times {factor:.2g}² (calibrated)"
    text = f"± {deviations:g} standard deviations, {source}"
    middle = mean[:, index]
    ax.fill_between(
        time, middle - spread, middle + spread, color=ESTIMATE, alpha=0.2, linewidth=0, label=text
    )
    shown = [middle - spread, middle + spread]
    if measurements is not None:
        seen = np.asarray(measurements.mask)[:, index]
        value = np.where(seen, np.asarray(measurements.value)[:, index], np.nan)
        _by_status(ax, np.asarray(measurements.time), value, np.asarray(trace.info.status))
        shown.append(value)
    ax.plot(time, middle, color=ESTIMATE, linewidth=1.5, label="estimate")
    if truth is not None:
        true = np.asarray(truth)
        true = true if true.ndim == 1 else true[:, index]
        ax.plot(time, true, color=TRUTH, linewidth=1.2, label="truth")
        shown.append(true)
    style.robust_limits(ax, np.concatenate(shown))
    style.label(ax, "time [s]", name or f"component {index}")
    style.legend_above(ax, 2)
    return ax


def innovations(trace: Trace, *, level: float = 0.95, ax: Axes | None = None) -> Axes:
    """NIS of every used measurement against time, with the chi-square band that holds `level` of
    them if the filter is consistent, by how many components were measured."""
    _check_single(trace)
    ax = style.own_axes(ax)
    status = np.asarray(trace.info.status)
    used = (status == Status.USED) | (status == Status.LATE_USED)
    value = np.where(used, np.asarray(nis(trace.info)), np.nan)
    size = np.shape(trace.info.innovation)[-1]
    time = np.asarray(trace.time) - np.where(used, np.asarray(trace.info.delay), 0)
    low, high = chi2_band(size, 1, level)
    ax.axhspan(
        low, high, color=style.BAND, alpha=0.25, linewidth=0, label=f"χ²({size}), {level:.0%}"
    )
    _by_status(ax, time, value, status)
    style.robust_limits(ax, value, floor=0.0)
    style.clipped(ax, time, value, "#555555")
    inside = np.mean((value[used] >= low) & (value[used] <= high)) if used.any() else np.nan
    style.label(ax, "validity time [s]", "NIS", f"{inside:.0%} of {used.sum()} inside the band")
    ax.legend(frameon=False, fontsize="small", loc="upper left")
    return ax


def consistency(
    trace: Trace, truth: Numbers, *, level: float = 0.95, ax: Axes | None = None
) -> Axes:
    """NEES against time, averaged over the runs of a batch, with the chi-square band that holds
    `level` of such averages if the covariance is honest."""
    ax = style.own_axes(ax)
    value, k = _nees_of(trace, truth)
    runs = 1 if value.ndim == 1 else value.shape[0]
    average = value if value.ndim == 1 else value.mean(0)
    time = np.asarray(trace.time)
    time = time if time.ndim == 1 else time.mean(0)
    low, high = chi2_band(k, runs, level)
    text = f"χ²({k}) over {runs} run{'s' * (runs > 1)}, {level:.0%}"
    ax.axhspan(low, high, color=style.BAND, alpha=0.25, linewidth=0, label=text)
    ax.plot(time, average, color=ESTIMATE, linewidth=1.3, label="NEES")
    style.robust_limits(ax, average, floor=0.0)
    style.clipped(ax, time, average, ESTIMATE)
    style.label(ax, "time [s]", "NEES")
    style.legend_above(ax)
    return ax


def arrivals(
    measurements: Measurement,
    arrival: Numbers = None,
    status: Numbers = None,
    *,
    ax: Axes | None = None,
) -> Axes:
    """Validity time against arrival time: what is on the diagonal arrived at once, what is below it
    late, by as much as it is below.

    Args:
        measurements: (T, ...) in order of arrival.
        arrival: (T,) seconds; default the number of the arrival.
        status: (T,) what became of each (`Trace.info.status`); default by sensor.
        ax: to draw on.
    """
    ax = style.own_axes(ax, 6.0, 5.0)
    time = np.asarray(measurements.time)
    when = np.arange(len(time)) if arrival is None else np.asarray(arrival)
    present = np.asarray(measurements.mask).any(1)
    if status is not None:
        _by_status(ax, when, np.where(present, time, np.nan), np.asarray(status))
    else:
        sensor = np.asarray(measurements.sensor)
        for k in np.unique(sensor):
            here = present & (sensor == k)
            mark, colour = style.MARKS[k % len(style.MARKS)], style.COLOURS[k % len(style.COLOURS)]
            ax.plot(when[here], time[here], mark, color=colour, ms=4, label=f"sensor {k}")
    if arrival is not None:
        ends = [min(when.min(), time.min()), max(when.max(), time.max())]
        ax.plot(ends, ends, color=TRUTH, linewidth=0.8, label="arrives at once")
    style.label(ax, "arrival" if arrival is None else "arrival time [s]", "validity time [s]")
    style.legend_above(ax)
    return ax


def calibrated_factor(trace: Trace, truth: Numbers) -> float:
    """By what standard deviations have to be multiplied for an average NEES of 1 per component: a
    band that is honest on average where the covariance is not (EWIF).

    Args:
        trace: of `run` or `run_batch`.
        truth: (T, k) or (R, T, k).
    """
    value, k = _nees_of(trace, truth)
    checks.require(np.isfinite(value).any(), "trace", "estimates", "none")
    return float(np.sqrt(np.mean(value[np.isfinite(value)]) / k))


def _nees_of(trace: Trace, truth: Numbers) -> tuple[np.ndarray, int]:
    """NEES (T,) or (R, T) of the first k components, and k."""
    true = np.asarray(truth)
    k = true.shape[-1]
    true = jnp.asarray(np.broadcast_to(true, (*np.shape(trace.mean)[:-1], k)))
    return np.asarray(nees(trace.mean, trace.cov, true)), k


def _check_single(trace: Trace) -> tuple[np.ndarray, np.ndarray]:
    one = isinstance(trace, Trace) and np.ndim(trace.mean) == 2
    checks.require(one, "trace", "the Trace of one series", type(trace).__name__)
    return np.asarray(trace.mean), np.asarray(trace.cov)


def _by_status(ax: Axes, x: np.ndarray, y: np.ndarray, status: np.ndarray) -> None:
    for kind in Status:
        color, mark, text = style.STATUS[kind.name.lower()]
        here = (status == kind) & np.isfinite(y)
        if here.any():
            size = 5 if kind == Status.USED else 5.5
            ax.plot(
                x[here], y[here], mark, color=color, markersize=size, label=text, linestyle="none"
            )
