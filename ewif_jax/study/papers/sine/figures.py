"""The figures of the sine study."""

from typing import Any

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from ewif_jax.study.shared.figures import EWIF, KALMAN, MEASURED, OTHER, TRUTH, label, study_canvas

COLOR = {"EWIF": EWIF, "KF": KALMAN}
SYMBOL = {"EWIF": r"$\tau$", "KF": r"$\sigma_w$"}
MARKS = (("o", "published"), ("s", "tuned on samples"), ("*", "exact optimum"))


def sine_tracks(example: dict[str, xr.DataArray]) -> Figure:
    """Fig. 1 of the paper: truth, measurements and the two estimates of one run."""
    figure, axes = study_canvas(width=9, height=4.5)
    time = example["truth"]["time"]
    axes.plot(time, example["measured"], ".", color=MEASURED, label="measurements")
    axes.plot(time, example["truth"], color=TRUTH, linewidth=1.2, label="truth")
    for name, style, given in (("EWIF", "-", "= 0.5 s"), ("KF", "--", "= 0.1 m")):
        error = float(np.sqrt(np.mean((example[name] - example["truth"]) ** 2)))
        text = f"{name}, {SYMBOL[name]} {given}: RMSE {error:.2f} m"
        axes.plot(time, example[name], style, color=COLOR[name], linewidth=1.6, label=text)
    axes.legend(ncols=2, frameon=False, fontsize="small", loc="lower left")
    label(axes, "time [s]", "signal [m]", "One realisation, published settings (variance 0.5)")
    return figure


def loss_curves(found: dict[str, Any]) -> Figure:
    """RMSE against the parameter: exact line, simulated points, and where each setting lies; below,
    by how much the simulated values differ from the exact ones."""
    shape = {"height_ratios": (3, 1)}
    figure, axes = study_canvas(
        2, 2, width=10, height=6, sharex="col", sharey="row", gridspec_kw=shape
    )
    for (above, below), (name, (one, of)) in zip(axes.T, found.items(), strict=True):
        color, value, error = COLOR[name], of["value"], 2 * of["rmse_se"]
        points = {"fmt": ".", "color": TRUTH, "capsize": 3, "label": "Monte Carlo ± 2 s.e."}
        above.semilogx(of["fine"], of["fine_exact"], color=color, label="exact expected RMSE")
        above.errorbar(value[3:], of["rmse"][3:], error[3:], **points)
        for k, (marker, text) in enumerate(MARKS):
            star = marker == "*"
            above.plot(
                value[k],
                of["exact"][k],
                marker,
                markersize=12 if star else 8,
                markerfacecolor=color if star else "none",
                markeredgecolor=color,
                label=f"{text}: {value[k]:.4g} {one.unit}",
                linestyle="none",
            )
        above.legend(frameon=False, fontsize="small")
        below.axhline(0, color=color)
        below.errorbar(value, of["rmse"] - of["exact"], error, **points)
        label(above, "", "RMSE [m]" if above is axes[0, 0] else "", name)
        side = "less exact [m]" if below is axes[1, 0] else ""
        label(below, f"{SYMBOL[name]} [{one.unit}]", side)
    return figure


def tuning_histories(found: dict[str, Any]) -> Figure:
    """Parameter and loss, gradient step by gradient step."""
    figure, axes = study_canvas(2, 2, width=10, height=6, sharex=True)
    for (above, below), (name, (one, of)) in zip(axes.T, found.items(), strict=True):
        color = COLOR[name]
        descents = [("on samples", OTHER, ":", of["sampled_path"], of["sampled_loss"])]
        for k, (start, style) in enumerate(zip(one.starts, ("-", "--"), strict=True)):
            text = f"on the exact error, from {start}"
            descents.append((text, color, style, of["path"][:, k], of["path_exact"][:, k]))
        above.axhline(of["optimum"][0], color=TRUTH, linewidth=0.7, label="exact optimum")
        for text, shade, style, path, loss in descents:
            above.semilogy(path, style, color=shade, label=text, linewidth=1.8)
            below.plot(loss, style, color=shade, linewidth=1.8)
        above.legend(frameon=False, fontsize="small")
        label(above, "", f"{SYMBOL[name]} [{one.unit}]", name)
        label(below, "gradient step", "RMSE [m]")
    return figure
