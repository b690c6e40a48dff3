"""The figures of the arrowhead study."""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure

from ewif_jax.scenarios.arrowhead import arrowhead_path
from ewif_jax.study.shared.figures import EWIF, KALMAN, MEASURED, OTHER, TRUTH, label, study_canvas
from ewif_jax.study.shared.late import DROPPED, rmse_of, rmses_of

LOOK = {
    "KF": (DROPPED, ":"),
    "selective Al1": (OTHER, "-"),
    "Al1": (KALMAN, "--"),
    "EWIF, tuned": (EWIF, "-."),
}


def path(example: Mapping[str, np.ndarray]) -> Figure:
    """Fig. 7: the path, the measurements of one lap, and how two methods follow it."""
    figure, axes = study_canvas(width=6.5, height=6.5)
    lap = (example["time"] > 126) & (example["time"] <= 252)
    axes.plot(*example["measured"][lap].T, ".", color=MEASURED, markersize=4, label="measured")
    around = arrowhead_path(np.linspace(0, 126, 500))
    axes.plot(*around.T, color=TRUTH, linewidth=1.2, label="truth")
    for name in ("selective Al1", "Al1"):
        color, style = LOOK[name]
        axes.plot(*example[name][lap].T, style, color=color, linewidth=1.4, label=name)
    axes.set_aspect("equal")
    axes.legend(frameon=False, fontsize="small")
    label(axes, "east [m]", "north [m]", "One lap: a measurement a second, 5 s late on average")
    return figure


def cutoff(
    cutoffs: np.ndarray, squared: np.ndarray, stale: float, lines: Sequence[tuple]
) -> Figure:
    """Fig. 8: RMSE against the cut-off, with the other methods as bands of ± 1 s.e."""
    figure, axes = study_canvas(width=8, height=4.5)
    values, errors = rmses_of(squared)
    inside = np.isfinite(cutoffs)
    axes.errorbar(
        cutoffs[inside],
        values[inside],
        errors[inside],
        fmt="o-",
        color=OTHER,
        markersize=4,
        capsize=3,
        label="selective Al1 ± 1 s.e.",
    )
    for (name, mse, _), color in zip(lines, (DROPPED, None, KALMAN, EWIF, None), strict=True):
        if color is not None:
            value, error = rmse_of(mse)
            axes.axhspan(value - error, value + error, color=color, alpha=0.3, linewidth=0)
            axes.axhline(value, color=color, linewidth=1, label=name)
    axes.axvline(stale, color=TRUTH, linestyle="--", linewidth=1, label="T_stale by eq. (8)")
    name, mse, _ = lines[-1]
    axes.plot([], [], " ", label=f"{name}: {rmse_of(mse).value:.1f} m, far below")
    axes.legend(frameon=False, fontsize="small")
    label(axes, "cut-off [s]", "RMSE [m]", "Old measurements harm a filter with a wrong model")
    return figure


def east_end(example: Mapping[str, np.ndarray]) -> Figure:
    """Fig. 9: the east coordinate around its maximum, where the filters lag."""
    figure, axes = study_canvas(width=9, height=4.2)
    time = example["time"]
    shown = (time > 126) & (time <= 252)
    axes.plot(time[shown], example["truth"][shown, 0], color=TRUTH, label="truth")
    for name, (color, style) in LOOK.items():
        axes.plot(time[shown], example[name][shown, 0], style, color=color, label=name)
    axes.legend(frameon=False, fontsize="small", ncols=2)
    label(axes, "time [s]", "east [m]", "One lap: how far each method lags behind")
    return figure
