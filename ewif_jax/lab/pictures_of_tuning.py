"""Pictures of parameters: how they were found, and what they are worth."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import numpy as np
from matplotlib.axes import Axes

from ewif_jax import checks
from ewif_jax.analysis.merit import delayed_gain
from ewif_jax.lab import style
from ewif_jax.lab.style import ESTIMATE, TRUTH
from ewif_jax.tuning import Tuned
from ewif_jax.types import Numbers, Params


def history(tuned: Tuned, *, ax: Axes | None = None) -> Axes:
    """Every number of the parameters, step by step of the descent, relative to the best (which is
    1), and the loss relative to the best loss."""
    ax = style.own_axes(ax)
    best = dict(_named_numbers(tuned.params))
    found = _named_numbers(tuned.history["params"])
    looks = style.looks([name for name, _ in found])
    for name, path in found:
        flat = path.reshape(len(path), -1)
        aim = np.ravel(best[name])
        for column, target in zip(flat.T, aim, strict=True):
            scale = target or 1.0
            look = looks[name]
            ax.plot(column / scale, color=look.color, linestyle=look.linestyle, label=name)
    loss = np.asarray(tuned.history["loss"])
    ax.plot(loss / (tuned.loss or 1.0), color=TRUTH, linewidth=1.0, label="loss")
    style.label(ax, "step of the descent", "relative to the best")
    handles, names = ax.get_legend_handles_labels()
    once = dict(zip(names, handles, strict=True))
    place: Any = {"loc": "lower left", "bbox_to_anchor": (0, 1), "borderaxespad": 0.3}
    ax.legend(once.values(), once, frameon=False, fontsize="small", ncols=4, **place)
    return ax


def landscape(
    loss: Callable[[Any], Any],
    name: str,
    values: Sequence[float],
    params: Params,
    *,
    best: float | None = None,
    error: float | None = None,
    ax: Axes | None = None,
) -> Axes:
    """The loss against one parameter, the others as in `params`, with the optimum and its standard
    error.

    Args:
        loss: params -> number.
        name: of the parameter.
        values: of it, where the loss is computed.
        params: the others.
        best: the optimum (default the lowest of `values`).
        error: its standard error.
        ax: to draw on.
    """
    ax = style.own_axes(ax)
    place = np.asarray(values, float)
    height = np.asarray([float(loss({**params, name: value})) for value in place])
    aim = float(place[np.nanargmin(height)]) if best is None else float(best)
    if error is not None:
        text = f"{aim:.4g} ± {error:.2g}"
        ax.axvspan(aim - error, aim + error, color=style.BAND, alpha=0.3, linewidth=0, label=text)
    ax.axvline(aim, color=ESTIMATE, linestyle="--", linewidth=1, label=f"optimum {aim:.4g}")
    ax.plot(place, height, "o-", color=TRUTH, markersize=3.5, linewidth=1.2, label="loss")
    if place.min() > 0 and place.max() / place.min() > 30:
        ax.set_xscale("log")
    style.robust_limits(ax, height)
    style.label(ax, name, "loss")
    style.legend_above(ax)
    return ax


def merit_map(
    F: Numbers,
    Q: Numbers,
    sensors: Mapping[str, tuple[Numbers, Numbers]],
    delays: Sequence[int],
    *,
    interval: float = 1.0,
    ax: Axes | None = None,
) -> Axes:
    """The value of a late measurement by sensor and delay: the norm of the gain that the ideal
    filter gives to it (`delayed_gain`, Yoder et al., eq. (5)), relative to that of the sensor
    whose fresh measurement has the largest.

    Args:
        F, Q: (n, n) motion over one interval.
        sensors: by name its H (m, n) and R (m, m).
        delays: in whole intervals.
        interval: in seconds.
        ax: to draw on.
    """
    ax = style.own_axes(ax, 7.0, 1.6 + 0.5 * len(sensors))
    checks.require(len(sensors) > 0, "sensors", "at least one sensor", "none")
    gains = np.asarray(
        [
            [float(np.linalg.norm(np.asarray(delayed_gain(F, H, Q, R, int(d))))) for d in delays]
            for H, R in sensors.values()
        ]
    )
    share = gains / gains.max()
    image = ax.imshow(share, cmap="cividis", vmin=0, vmax=1, aspect="auto")
    ax.grid(False)
    ax.set_yticks(range(len(sensors)), list(sensors))
    ax.set_xticks(range(len(delays)), [f"{d * interval:g}" for d in delays])
    for (row, column), x in np.ndenumerate(share):
        shade = "white" if x < 0.55 else "black"
        ax.text(column, row, f"{x:.2f}", color=shade, ha="center", va="center", fontsize="small")
    ax.figure.colorbar(image, ax=ax, label="gain, relative")
    style.label(ax, "delay [s]", "")
    return ax


def _named_numbers(params: Params) -> list[tuple[str, np.ndarray]]:
    leaves = jax.tree_util.tree_leaves_with_path(params)
    return [
        (jax.tree_util.keystr(path, simple=True, separator=".") or "params", np.asarray(x))
        for path, x in leaves
    ]
