"""The figures of the study of latencies."""

import numpy as np
from matplotlib.colors import BoundaryNorm
from matplotlib.figure import Figure

from ewif_jax.study.papers.latency.runs import NAMES, NORMAL_95, POINTS, ROWS, TRUTH
from ewif_jax.study.shared.figures import EWIF, MEASURED, OTHER, label, study_canvas
from ewif_jax.study.shared.figures import TRUTH as BLACK
from ewif_jax.study.shared.folder import Arrays


def landscape(fits: Arrays, grid: Arrays) -> Figure:
    """The likelihood of the first run over both latencies, q at its best, and where the gradient
    ends."""
    figure, axes = study_canvas(width=6.5, height=5.5)
    points = grid["points"].reshape(*POINTS, 3)
    below = (grid["cost"][0] - fits["cost"][0]).reshape(POINTS).min(0) * ROWS
    first, second = points[0, :, 0, 1], points[0, 0, :, 2]
    levels = [0, 1, 3, 10, 30, 100, 300, 1000]
    shades = BoundaryNorm(levels, 256, extend="max")
    filled = axes.contourf(
        first, second, below.T, levels, cmap="viridis_r", norm=shades, extend="max"
    )
    figure.colorbar(filled, ax=axes, label="log likelihood below its maximum", spacing="uniform")
    axes.plot(*fits["point"][:, 1:].T, ".", color=BLACK, markersize=2.5, label="all runs")
    spread = NORMAL_95 * fits["error"][0, 1:]
    where = fits["point"][0, 1:]
    axes.errorbar(*where, spread[1], spread[0], fmt="o", color="red", label="this run, 95 %")
    axes.plot(*TRUTH[1:], "*", color="white", markeredgecolor=BLACK, markersize=15, label="truth")
    axes.legend(fontsize="small", loc="upper left")
    label(axes, "latency of clock 1 [s]", "latency of clock 2 [s]", "One run of 60 s")
    return figure


def estimates(fits: Arrays) -> Figure:
    """How the estimates scatter, beside the Cramer-Rao bound and the errors they claim."""
    figure, axes = study_canvas(1, 3, width=12, height=3.8)
    units = ("", " [s]", " [s]")
    for k, (ax, name, unit) in enumerate(zip(axes, NAMES, units, strict=True)):
        off = fits["point"][:, k] - TRUTH[k]
        bound, claimed = fits["bound"][k], fits["error"][:, k].mean()
        ax.hist(off, 30, density=True, color=MEASURED, label="estimates")
        grid = np.linspace(-4, 4, 200) * bound
        for sd, color, style, text in (
            (bound, EWIF, "-", "Cramer-Rao bound"),
            (claimed, OTHER, "--", "claimed on average"),
        ):
            density = np.exp(-(grid**2) / (2 * sd**2)) / (sd * np.sqrt(2 * np.pi))
            ax.plot(grid, density, style, color=color, label=text)
        label(ax, f"error of {name}{unit}", "density" if k == 0 else "")
    axes[0].legend(frameon=False, fontsize="small")
    return figure
