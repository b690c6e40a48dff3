"""Figures of a comparison."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ewif_jax import checks
from ewif_jax.analysis.storage import storage
from ewif_jax.lab import methods as lines
from ewif_jax.lab import moments, style
from ewif_jax.moments import standard_error

if TYPE_CHECKING:
    from ewif_jax.lab.comparison import Comparison

TIME = "time"
ERRORS = 2
"""standard errors that a bar shows to each side"""


def grid_figure(
    comparison: "Comparison",
    x: str | None,
    metric: str | None,
    *,
    at: Mapping[str, float] | None = None,
    reference: str | None = None,
    log: bool = False,
) -> Figure:
    """What `Comparison.plot` draws."""
    design = comparison.design
    metric = _chosen_metric(comparison, metric)
    comparison._require_method("reference", reference)
    if x is None:
        x = next(iter(design.axes), TIME)
    choices = [*design.axes, TIME]
    checks.require(x in choices, "x", f"one of {', '.join(choices)}", repr(x))
    chosen = _point_numbers(comparison, at)
    panels: dict[tuple, list[int]] = {}
    for number in chosen:
        point = comparison.points[number]
        panels.setdefault(tuple((k, v) for k, v in point.items() if k != x), []).append(number)
    columns = min(len(panels), 3)
    rows = -(-len(panels) // columns)
    width, height = (7.5 if columns == 1 else 3.6 * columns + 0.6), 3.0 * rows + 1.2
    figure, axes = style.canvas(
        rows, columns, width=width, height=height, sharex=True, sharey=not log and x != TIME
    )
    for extra in axes.ravel()[len(panels) :]:
        extra.set_visible(False)
    for ax, (others, numbers) in zip(axes.ravel(), panels.items(), strict=False):
        if x == TIME:
            _against_time(ax, comparison, numbers[0], metric, reference)
        else:
            _against_axis(ax, comparison, numbers, x, metric, reference)
        if log:
            ax.set_yscale("log")
        title = ", ".join(f"{name} = {value:g}" for name, value in others)
        is_left = ax in axes[:, 0]
        unit = "time [s]" if x == TIME else x
        style.label(ax, unit, _axis_label(comparison, metric, reference) if is_left else "", title)
    handles, names = axes[0, 0].get_legend_handles_labels()
    place = "outside upper left"
    figure.legend(handles, names, loc=place, ncols=min(len(names), 5), frameon=False)
    return figure


def _against_axis(
    ax: Axes,
    comparison: "Comparison",
    numbers: list[int],
    x: str,
    metric: str,
    reference: str | None,
) -> None:
    place = np.asarray([comparison.points[n][x] for n in numbers])
    order = np.argsort(place)
    values, errors = zip(
        *(_metric_values(comparison, n, metric, reference) for n in numbers), strict=True
    )
    value, error = np.stack(values)[order], np.stack(errors)[order]
    for k, (name, look) in enumerate(style.looks(comparison.methods).items()):
        bars: dict[str, Any] = {"capsize": 2.5, "markersize": 4.5, "linewidth": 1.5}
        ax.errorbar(
            place[order], value[:, k], ERRORS * error[:, k], label=name, **look._asdict(), **bars
        )


def _against_time(
    ax: Axes, comparison: "Comparison", number: int, metric: str, reference: str | None
) -> None:
    checks.require(reference is None, "reference", "None against time", repr(reference))
    found = comparison.over_time[metric][number]
    time, errors = comparison.times(number), standard_error(found)
    root = metric in comparison.design.roots
    mean = found.mean
    with np.errstate(invalid="ignore", divide="ignore"):
        value = np.sqrt(mean) if root else mean
        errors = errors / (2 * value) if root else errors
    for k, (name, look) in enumerate(style.looks(comparison.methods).items()):
        every = max(len(time) // 12, 1)
        options: dict[str, Any] = {"markevery": (k * every // 5, every), **look._asdict()}
        ax.plot(time, value[k], label=name, markersize=4, linewidth=1.4, **options)
        low, high = value[k] - ERRORS * errors[k], value[k] + ERRORS * errors[k]
        ax.fill_between(time, low, high, color=look.color, alpha=0.15, linewidth=0)
    band = ERRORS * np.nan_to_num(errors)
    style.robust_limits(ax, np.stack([value - band, value + band]))


def pareto_figure(
    comparison: "Comparison",
    cost: str,
    metric: str | None,
    *,
    at: Mapping[str, float] | None = None,
) -> Figure:
    """What `Comparison.pareto` draws."""
    metric = _chosen_metric(comparison, metric)
    costs = ("seconds", "numbers")
    checks.require(cost in costs, "cost", "'seconds' or 'numbers'", repr(cost))
    number = _point_numbers(comparison, at)[0]
    value, error = _metric_values(comparison, number, metric, None)
    spent = (
        _seconds_spent(comparison, number)
        if cost == "seconds"
        else _axis_numbers(comparison, number)
    )
    figure, axes = style.canvas(width=7, height=4.5)
    ax = axes[0, 0]
    for k, (name, look) in enumerate(style.looks(comparison.methods).items()):
        drawn: dict[str, Any] = {"color": look.color, "marker": look.marker, "linestyle": "none"}
        drawn |= {"capsize": 3, "markersize": 7, "label": name}
        ax.errorbar(spent[k], value[k], ERRORS * error[k], **drawn)
        near: dict[str, Any] = {"textcoords": "offset points", "xytext": (7, 5)}
        ax.annotate(name, (spent[k], value[k]), color=look.color, fontsize="small", **near)
    best = front(spent, value)
    ax.plot(spent[best], value[best], color="#555555", linewidth=0.8, zorder=0)
    ax.set_xscale("log")
    ax.set_xlim(spent.min() / 2, spent.max() * 3)  # room for the names
    style.plain_log_ticks(ax)
    units = {"seconds": "seconds per arrival and run, filtering only", "numbers": "numbers stored"}
    point = ", ".join(f"{name} = {x:g}" for name, x in comparison.points[number].items())
    style.label(ax, units[cost], _axis_label(comparison, metric, None), point)
    return figure


def front(cost: np.ndarray, value: np.ndarray) -> np.ndarray:
    """Indices of what nothing else beats in both, by cost."""
    order = np.lexsort((value, cost))
    kept, best = [], np.inf
    for k in order:
        if value[k] < best:
            kept.append(k)
            best = value[k]
    return np.asarray(kept, int)


def _metric_values(
    comparison: "Comparison", number: int, metric: str, reference: str | None
) -> tuple[np.ndarray, np.ndarray]:
    found = comparison._moments[number][f"score/{metric}"]
    root = metric in comparison.design.roots
    if reference is None:
        return moments.means(found, root)
    return moments.differences(found, comparison.methods.index(reference), root)


def _seconds_spent(comparison: "Comparison", number: int) -> np.ndarray:
    cost = comparison.cost
    here = np.ones(len(cost), bool)
    for name, value in comparison.points[number].items():
        here &= cost[name].to_numpy() == value
    return cost["seconds_per_arrival"].to_numpy()[here]


def _axis_numbers(comparison: "Comparison", number: int) -> np.ndarray:
    found = []
    point = comparison.points[number]
    for name in comparison.methods:
        method = comparison.design.methods[name]
        size = comparison.design.sizes[name]
        params = lines.at_point(method.params, point)
        found.append(storage(method.estimator, size, params=params).numbers)
    return np.asarray(found, float)


def _chosen_metric(comparison: "Comparison", metric: str | None) -> str:
    names = list(comparison.design.metrics)
    checks.require(metric in (None, *names), "metric", f"one of {', '.join(names)}", repr(metric))
    return names[0] if metric is None else metric


def _point_numbers(comparison: "Comparison", at: Mapping[str, float] | None) -> list[int]:
    """Numbers of the points that `at` leaves."""
    axes = comparison.design.axes
    for name, value in (at or {}).items():
        checks.require(name in axes, "at", f"axes among {', '.join(axes) or 'none'}", repr(name))
        values = ", ".join(f"{x:g}" for x in axes[name])
        checks.require(value in axes[name], f"at[{name!r}]", f"one of {values}", repr(value))
    wanted = dict(at or {})
    return [
        k
        for k, point in enumerate(comparison.points)
        if all(point[name] == value for name, value in wanted.items())
    ]


def _axis_label(comparison: "Comparison", metric: str, reference: str | None) -> str:
    plain = metric.replace("_", " ")
    shown = f"RMSE, {plain}" if metric in comparison.design.roots else f"mean {plain}"
    if metric == "squared_error":
        shown = "RMSE"
    return shown if reference is None else f"{shown}, minus {reference}"
