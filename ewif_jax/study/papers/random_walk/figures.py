"""The figures of the random walk study."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.figure import Figure

from ewif_jax.study.shared.figures import EWIF, KALMAN, OTHER, TRUTH, label, study_canvas
from ewif_jax.study.shared.late import DROPPED, rmse_of, rmses_of

EXACT = "#222222"


def method_panels(
    cases: Sequence[Any],
    found: Sequence[Mapping[str, np.ndarray]],
    theoretical: Callable[[float], float],
    multiples: np.ndarray,
) -> Figure:
    """Fig. 4: RMSE against the cut-off, one panel for each process noise."""
    figure, axes = study_canvas(1, 3, width=13, height=4.4)
    inside = np.isfinite(multiples) & (multiples > 0)
    for ax, case, one in zip(axes, cases, found, strict=True):
        limit = theoretical(case.sigma)
        squared = one["squared_error"]
        levels = (
            ("KF, late dropped", squared[0], DROPPED, ":"),
            ("Al1, everything", squared[-1], KALMAN, "--"),
            ("exact, everything", one["exact"], EXACT, "-"),
            ("EWIF, everything", one["ewif"], EWIF, "-."),
        )
        for name, mse, color, style in levels:
            value, error = rmse_of(mse)
            ax.axhspan(value - error, value + error, color=color, alpha=0.12, linewidth=0)
            ax.axhline(value, color=color, linestyle=style, linewidth=1.2, label=name)
        values, errors = rmses_of(squared)
        ax.errorbar(
            multiples[inside] * limit,
            values[inside],
            errors[inside],
            fmt="o-",
            color=OTHER,
            markersize=4,
            capsize=3,
            label="selective Al1",
        )
        ax.axvline(limit, color=TRUTH, linestyle="--", linewidth=0.9, label="T_d of eq. (8)")
        ax.set_xscale("log")
        title = f"{case.name}: sigma_Q = {case.sigma:g}, mean delay {case.delay:g} s"
        label(ax, "cut-off [s]", "RMSE [m] ± 1 s.e." if ax is axes[0] else "", title)
    axes[0].legend(frameon=False, fontsize="small")
    return figure


def delay_panels(
    squared: np.ndarray,
    sigmas: Sequence[float],
    mean_delays: np.ndarray,
    theoretical: Callable[[float], float],
    multiples: np.ndarray,
    wide: bool,
) -> Figure:
    """Figs. 5 (linear, narrow) and 6 (logarithmic, wide): one curve for each mean delay, from
    `squared` (V, sigmas, delays, R)."""
    figure, axes = study_canvas(2, 2, width=11, height=7.5)
    colors = colormaps["viridis"](np.linspace(0, 0.9, mean_delays.size))
    shown = np.isfinite(multiples) & ((multiples > 0) if wide else (multiples <= 5))
    for number, (ax, sigma) in enumerate(zip(axes.flat, sigmas, strict=True)):
        limit = theoretical(sigma)
        for i, delay in enumerate(mean_delays):
            values, errors = rmses_of(squared[:, number, i])
            best = int(np.argmin(values[shown]))
            cutoffs = multiples[shown] * limit
            ax.errorbar(
                cutoffs,
                values[shown],
                errors[shown],
                fmt=".-",
                color=colors[i],
                linewidth=1,
                capsize=2,
                label=f"{delay:g} s",
            )
            ax.plot(cutoffs[best], values[shown][best], "o", color=colors[i], fillstyle="none")
        ax.axvline(limit, color=TRUTH, linestyle="--", linewidth=0.9)
        if wide:
            ax.set_xscale("log")
        label(
            ax,
            "cut-off [s]" if number > 1 else "",
            "RMSE [m] ± 1 s.e." if number % 2 == 0 else "",
            f"sigma_Q = {sigma:g}: T_d = {limit:.3g} s (dashed)",
        )
    axes[0, 0].legend(title="mean delay", frameon=False, fontsize="x-small", ncols=2)
    return figure
