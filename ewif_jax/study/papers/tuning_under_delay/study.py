"""A cut-off learned together with q of Al1, and with tau of the EWIF, by gradient through late
measurements: the arrowhead of Yoder et al. again."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from ewif_jax.estimators.ewif import ewif
from ewif_jax.losses import rmse_loss
from ewif_jax.monte_carlo import Simulation, simulate_batch
from ewif_jax.oosm.al1 import al1
from ewif_jax.oosm.selective import selective
from ewif_jax.scenarios.arrowhead import arrowhead, arrowhead_model
from ewif_jax.study.papers.arrowhead.study import VARIANCE, stale
from ewif_jax.study.shared.experiment import Experiment
from ewif_jax.study.shared.figures import EWIF, OTHER, TRUTH, label, study_canvas
from ewif_jax.study.shared.late import history_needed, paired, rmse_of, sweep
from ewif_jax.tuning import Tuned, tune
from ewif_jax.types import Estimator, Gaussian, PyTree

SOFTNESS = 0.5
"""width of the soft cut-off in seconds: half the spacing of the possible delays"""


class DelayMethod(NamedTuple):
    """A method with a cut-off: build(lag, softness), the parameter beside the cut-off, its symbol
    and published value, the grid of both, and whether the start is known."""

    name: str
    build: Callable[[int, float | None], Estimator]
    parameter: str
    symbol: str
    published: float
    grid: np.ndarray
    prior: bool


CUTOFFS = np.asarray([0.0, 2.0, 3.0, 4.0, 5.0, stale(), 8.0, 12.0, 20.0, np.inf])


def delay_methods() -> tuple[DelayMethod, DelayMethod]:
    """Al1 in (q, cut-off) and EWIF in (tau, cut-off)."""

    def by_al1(lag: int, softness: float | None) -> Estimator:
        base = al1(arrowhead_model(lambda p: p["q"], VARIANCE), lag)
        return selective(base, lambda p: p["cutoff"], softness)

    def by_ewif(lag: int, softness: float | None) -> Estimator:
        del lag
        base = ewif(arrowhead_model(0.0, VARIANCE), tau=lambda p: p["tau"])
        return selective(base, lambda p: p["cutoff"], softness)

    qs = 20.0 * np.asarray([0.5, 1, 2, 4, 6, 8, 12, 16])
    taus = np.asarray([1.5, 2.5, 3, 3.5, 4, 5, 7, 10])
    return (
        DelayMethod("Al1", by_al1, "q", "q [m²/s]", 20.0, qs, True),
        DelayMethod("EWIF", by_ewif, "tau", "τ [s]", 10.0, taus, False),
    )


def run(experiment: Experiment) -> None:
    """Tunes, evaluates on other runs, compares with a grid, and draws."""
    quick = experiment.options.quick
    runs, steps = experiment.size(30, 4), 300 if quick else 3000
    scenario = arrowhead(r=VARIANCE, steps=steps)
    batch = simulate_batch(scenario, jax.random.split(experiment.key(0), runs))
    few = arrowhead(r=VARIANCE, steps=300 if quick else 1000)
    seen = simulate_batch(few, jax.random.split(experiment.key(1), 4 if quick else 16))
    lag = max(history_needed(x.measurements) for x in (batch, seen))
    rows, arrays, drawn = [], {}, []
    for one in delay_methods():
        prior = scenario.prior if one.prior else None
        found = experiment.piece(
            one.name, lambda m=one, p=prior: _found_optimum(experiment, m, lag, seen, batch, p)
        )
        rows += _optimum_rows(one, found)
        arrays |= _optimum_arrays(one, found)
        drawn.append((one, found))
    experiment.arrays("tuning_under_delay", xr.Dataset(arrays))
    experiment.figure("landscape", _draw_landscape(drawn))
    experiment.figure("descent", _draw_descent(drawn))
    experiment.table(
        "tuning_under_delay",
        f"Arrowhead, tuned through late measurements, {runs} test runs of {steps}",
        rows,
        [
            f"The gradient sees a cut-off softened by {SOFTNESS:g} s, on training runs; delays are "
            "whole seconds.",
            "published: q and T_stale of the paper, and the τ of the same gain without a cut-off.",
            "Two separate searches: (q, cut-off) of Al1 and (τ, cut-off) of the EWIF. No method",
            "has both a q and a τ.",
        ],
    )
    experiment.finish()


def _found_optimum(
    experiment: Experiment,
    one: DelayMethod,
    lag: int,
    seen: Simulation,
    batch: Simulation,
    prior: Gaussian | None,
) -> dict[str, Any]:
    setting = {"prior": prior, "t0": 0.0}
    soft, hard = one.build(lag, SOFTNESS), one.build(lag, None)
    tuned = _tuned_cutoff(experiment, one, soft, seen, setting)
    learned = {name: float(value) for name, value in tuned.params.items()}
    cut = stale() if one.name == "Al1" else np.inf
    pairs = [(one.published, cut), (learned[one.parameter], learned["cutoff"])]
    pairs += [(value, cutoff) for value in one.grid for cutoff in CUTOFFS]
    settings = {
        one.parameter: np.asarray([p[0] for p in pairs]),
        "cutoff": np.asarray([p[1] for p in pairs]),
    }
    label = f"{one.name}: grid"
    with experiment.timed(label), experiment.progress(label) as report:
        squared = sweep(
            hard, settings, batch, chunk=experiment.options.chunk, progress=report, **setting
        )["squared_error"]
        second = {name: x[1:2] for name, x in settings.items()}
        softly = sweep(soft, second, batch, **setting)["squared_error"]
    return {
        "squared": squared,
        "softly": softly[0],
        "parameter": settings[one.parameter],
        "cutoff": settings["cutoff"],
        "descent": np.stack([tuned.history["params"][k] for k in (one.parameter, "cutoff")]),
        "loss": tuned.history["loss"],
    }


def _tuned_cutoff(
    experiment: Experiment, one: DelayMethod, soft: Estimator, seen: Simulation, setting: Any
) -> Tuned:
    label = f"{one.name}: tuning"
    start = {one.parameter: one.published, "cutoff": 2.0}
    with experiment.timed(label), experiment.progress(label) as report:
        loss = rmse_loss(soft, seen.measurements, seen.truth, **setting)
        steps = 20 if experiment.options.quick else 80
        return tune(loss, start, method="adam", steps=steps, progress=report)


def _optimum_rows(one: DelayMethod, found: PyTree) -> list[dict[str, Any]]:
    squared, values, cutoffs = found["squared"], found["parameter"], found["cutoff"]
    best = 2 + int(np.argmin(squared[2:].mean(1)))
    picked = [
        ("published", 0, squared[0]),
        ("learned, hard cut-off", 1, squared[1]),
        ("learned, soft cut-off", 1, found["softly"]),
        ("best of the grid, chosen on the test runs", best, squared[best]),
    ]
    return [
        {
            "method": one.name,
            "setting": name,
            "parameter": one.symbol,
            "value": float(values[i]),
            "cut-off [s]": float(cutoffs[i]),
            "RMSE [m]": rmse_of(mse),
            "minus published [m]": paired(mse, squared[0]) if i else None,
            "minus best of the grid [m]": paired(mse, squared[best]) if i != best else None,
        }
        for name, i, mse in picked
    ]


def _optimum_arrays(one: DelayMethod, found: PyTree) -> dict[str, xr.DataArray]:
    name, metres = one.name, {"units": "m"}
    grid = found["squared"][2:].reshape(one.grid.size, CUTOFFS.size, -1)
    return {
        f"{name}_grid_rmse_of_run": xr.DataArray(
            np.sqrt(grid),
            dims=(one.parameter, "cutoff", "run"),
            attrs=metres,
            coords={one.parameter: one.grid, "cutoff": ("cutoff", CUTOFFS, {"units": "s"})},
        ),
        f"{name}_named_rmse_of_run": xr.DataArray(
            np.sqrt(np.stack([*found["squared"][:2], found["softly"]])),
            dims=("setting", "run"),
            coords={"setting": ["published", "learned, hard", "learned, soft"]},
            attrs=metres,
        ),
        f"{name}_draw_descent": xr.DataArray(
            found["descent"],
            dims=(f"{name}_component", "step"),
            coords={f"{name}_component": [one.parameter, "cutoff"]},
        ),
        f"{name}_loss": xr.DataArray(found["loss"], dims="step", attrs=metres),
    }


def _draw_landscape(drawn: list[tuple[DelayMethod, Any]]) -> Figure:
    """RMSE over the grid, the way of the descent, and where it ends."""
    figure, axes = study_canvas(1, 2, width=12, height=4.8)
    shown = np.isfinite(CUTOFFS)
    for ax, (one, found) in zip(axes, drawn, strict=True):
        mean = np.sqrt(found["squared"][2:].mean(1)).reshape(one.grid.size, CUTOFFS.size)
        span = mean[:, shown].max() - mean.min()
        levels = mean.min() + span * np.linspace(0, 1, 17) ** 3
        filled = ax.contourf(CUTOFFS[shown], one.grid, mean[:, shown], levels, cmap="viridis")
        figure.colorbar(filled, ax=ax, label="RMSE [m]", spacing="uniform", format="%.1f")
        ax.plot(*found["descent"][::-1], "-", color="white", linewidth=1.5, label="descent")
        ax.plot(*found["descent"][::-1, -1], "*", color="red", markersize=13, label="learned")
        if np.isfinite(found["cutoff"][0]):
            ax.plot(
                found["cutoff"][0],
                found["parameter"][0],
                "s",
                color="white",
                markersize=7,
                label="published",
            )
        ax.set_xlim(0, 20)
        ax.legend(fontsize="small", loc="upper right")
        label(ax, "cut-off [s]", one.symbol, f"{one.name}, hard cut-off")
    return figure


def _draw_descent(drawn: list[tuple[DelayMethod, Any]]) -> Figure:
    """Parameter, cut-off and loss, gradient step by gradient step."""
    figure, axes = study_canvas(1, 3, width=13, height=3.8)
    colors = {"Al1": OTHER, "EWIF": EWIF}
    twin = axes[0].twinx()
    for ax, (one, found) in zip((axes[0], twin), drawn, strict=True):
        ax.plot(found["descent"][0], color=colors[one.name], label=one.name)
        ax.set_ylabel(one.symbol, color=colors[one.name])
        axes[1].plot(found["descent"][1], color=colors[one.name], label=one.name)
        axes[2].plot(found["loss"], color=colors[one.name], label=one.name)
    axes[0].set_xlabel("gradient step")
    axes[1].axhline(stale(), color=TRUTH, linestyle="--", linewidth=0.9, label="T_stale of eq. (8)")
    axes[1].legend(frameon=False, fontsize="small")
    label(axes[1], "gradient step", "cut-off [s]")
    label(axes[2], "gradient step", "training RMSE [m]")
    return figure
