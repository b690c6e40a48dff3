"""The figures of the divergence study."""

from collections.abc import Mapping

import numpy as np
from matplotlib.figure import Figure

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

COLOR = {"none": TRUTH, "noise": KALMAN, "weighting": EWIF, "memory": OTHER}
STYLE = {"none": "-", "noise": (0, (4, 4)), "weighting": "-", "memory": "-"}
ABOVE = {"none": 2.0, "noise": 2.2, "weighting": 2.1, "memory": 2.0}
"""what covers what: two of the lines coincide"""
POINTS = 14


def growth_curves(
    time: np.ndarray, found: Mapping, exact: Mapping, text: Mapping[str, str]
) -> Figure:
    """Mean square error against time, exact lines and simulated points, for both pushes; dotted,
    what the filter without a remedy believes."""
    figure, axes = study_canvas(1, 2, width=11, height=4.6, sharey=True)
    for ax, push in zip(axes, ("white", "constant"), strict=True):
        for shift, (remedy, color) in enumerate(COLOR.items()):
            line = {"color": color, "linestyle": STYLE[remedy], "zorder": ABOVE[remedy]}
            ax.semilogy(time, exact[push, remedy], linewidth=1.6, **line)
            at = np.linspace(0, time.size - 1, 4 * POINTS + 5).astype(int)[4 + shift :: 4]
            one = found[push, remedy]
            ax.errorbar(
                time[at],
                one["mse"][at],
                2 * one["mse_se"][at],
                fmt=".",
                color=color,
                capsize=2,
                markersize=5,
                linewidth=1,
                label=text[remedy],
            )
        ax.semilogy(time, 1 / (time + 1), ":", color=MEASURED, label="believed without a remedy")
        label(ax, "time [s]", "", f"{push} push")
    axes[0].set_ylabel("mean square error [1]")
    plain_ticks(axes[0])
    axes[0].plot([], [], color=MEASURED, label="lines: exact; points: simulated ± 2 s.e.")
    axes[0].legend(frameon=False, fontsize="small", loc="upper left", ncols=2)
    axes[0].set_ylim(top=40)
    return figure


def setting_curves(
    gains: np.ndarray, final: Mapping, exact: Mapping, used: float, text: Mapping[str, str]
) -> Figure:
    """Error at the end against how fast each remedy forgets, and the error without one."""
    figure, axes = study_canvas(1, 2, width=11, height=4.2, sharey=True)
    for ax, push in zip(axes, ("white", "constant"), strict=True):
        ax.axhline(exact[push, "none"][-1], color=TRUTH, label="no remedy")
        for remedy, color in list(COLOR.items())[1:]:
            curve = final[push, remedy]
            line = {"color": color, "linestyle": STYLE[remedy], "zorder": ABOVE[remedy]}
            ax.loglog(gains, curve, linewidth=1.6, label=text[remedy], **line)
            best = int(np.argmin(curve))
            ax.plot(gains[best], curve[best], "o", color=color, fillstyle="none")
        ax.axvline(
            used, color=MEASURED, linewidth=0.8, linestyle=":", label="√ε, best for the white push"
        )
        label(ax, "gain, or 1 / memory [1/s]", "", f"{push} push (circles: least)")
        plain_ticks(ax)
    axes[0].set_ylabel("mean square error at the end [1]")
    axes[0].legend(frameon=False, fontsize="small")
    return figure
