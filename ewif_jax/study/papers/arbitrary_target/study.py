"""Fig. 2 of Shulami & Sigalov: one EWIF as filter and as smoother, with and without the late
sensor; and the estimate that looks both ways."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr

from ewif_jax.estimator import run as run_filter
from ewif_jax.estimators.ewif import ewif
from ewif_jax.monte_carlo import monte_carlo, simulate_batch
from ewif_jax.scenarios.arbitrary_target import (
    arbitrary_path,
    arbitrary_target,
    arbitrary_target_model,
)
from ewif_jax.study.papers.arbitrary_target import figures
from ewif_jax.study.papers.two_sided import runs as two_sided
from ewif_jax.study.shared.experiment import Experiment
from ewif_jax.study.shared.late import paired, rmse_of, sweep
from ewif_jax.types import Estimator

TAU, LAG = 2.0, 1.0
TAUS = np.asarray([0.7, 1.0, 1.4, TAU, 2.8])
REGIMES = {
    "filter, in sequence only": (0.0, False),
    "smoother (1 s), in sequence only": (1.0, False),
    "filter, late ones too": (0.0, True),
    "smoother (1 s), late ones too": (1.0, True),
}
"""lag in seconds, and whether the late sensor is used"""


def run(experiment: Experiment) -> None:
    """Tracks the target under the four regimes, draws and animates it."""
    runs = experiment.size(1000, 20)
    estimator = ewif(arbitrary_target_model(), tau=lambda p: p["tau"])
    squared = {}
    for i, name in enumerate(REGIMES):
        squared[name] = experiment.piece(
            f"regime-{i}", lambda n=name: _squared_errors(experiment, estimator, n, runs)
        )
    example = _example_run(experiment, estimator)
    experiment.arrays("arbitrary_target", _study_arrays(squared, example))
    experiment.figure("fig2", figures.snapshot(example, list(REGIMES)))
    with experiment.timed("animation"):
        frames = figures.animation(example, list(REGIMES), 5 if experiment.options.quick else 60)
        experiment.folder.write("animation.gif", frames)
    base, *others = squared.items()
    rows = [
        {"regime": base[0], "RMSE [m]": rmse_of(base[1]["squared_error"]), "difference [m]": None}
    ]
    rows += [
        {
            "regime": name,
            "RMSE [m]": rmse_of(x["squared_error"]),
            "difference [m]": paired(x["squared_error"], base[1]["squared_error"]),
        }
        for name, x in others
    ]
    fewer = min(runs, 250)
    with experiment.timed("two-sided"):
        both = experiment.piece("two-sided", lambda: smoothed(experiment.key(0), fewer, TAUS))
    experiment.table(
        "smoothers",
        f"With the late ones, {fewer} runs, by decay time",
        two_sided.table_rows(both, TAUS, list(TAUS).index(TAU)),
        [
            f"Errors in m. fixed lag: {LAG:g} s behind the arrivals. two-sided: at the times of",
            "the fixed lag, from all the measurements of the minute. above: run by run, best tau.",
        ],
    )
    experiment.table(
        "arbitrary_target",
        f"Arbitrary target, {runs} runs, EWIF with τ = {TAU:g} s",
        rows,
        ["difference: from the first row, run by run."],
    )
    experiment.finish()


def smoothed(key: jax.Array, runs: int, taus: np.ndarray) -> dict[str, np.ndarray]:
    """Mean squared errors (V, R) for V decay times of the filter, its fixed lag and the two-sided
    estimate, late measurements used; the runs are those of the other table."""
    model = arbitrary_target_model()
    estimator = ewif(model, tau=lambda p: p["tau"])
    keys = jax.vmap(lambda i: jax.random.fold_in(key, i))(jnp.arange(runs))
    found = {}
    for name, lag in (("filter", 0.0), ("fixed lag", LAG)):
        batch = simulate_batch(arbitrary_target(lag), keys)
        swept = sweep(estimator, {"tau": taus}, batch, prior=None, t0=0.0)
        found[name] = swept["squared_error"]
    found["two-sided"] = np.stack([two_sided.two_sided_errors(model, t, batch) for t in taus])
    return found


def _squared_errors(
    experiment: Experiment, estimator: Estimator, name: str, runs: int
) -> dict[str, np.ndarray]:
    scenario = arbitrary_target(*REGIMES[name])
    with experiment.timed(name), experiment.progress(name) as report:
        return monte_carlo(
            estimator,
            {"tau": jnp.asarray(TAU)},
            scenario,
            runs=runs,
            key=experiment.key(0),
            chunk=experiment.options.chunk,
            progress=report,
        ).per_run


def _example_run(experiment: Experiment, estimator: Estimator) -> dict[str, Any]:
    """One realisation: measurements by sensor, report times, truth, and the four tracks."""
    found: dict[str, Any] = {}
    with experiment.timed("one realisation"):
        key = experiment.key(1)
        for name, (lag, late) in REGIMES.items():
            one = arbitrary_target(lag, late).simulate(key)
            trace = run_filter(
                estimator,
                {"tau": jnp.asarray(TAU)},
                one.measurements,
                prior=None,
                t0=0.0,
                times=one.times,
            )
            found[name] = np.asarray(trace.mean[:, :2])
            if lag == 0:
                found["arrival"] = np.asarray(one.times)
        found["time"] = np.asarray(one.measurements.time)
        found["sensor"] = np.asarray(one.measurements.sensor)
        found["measured"] = np.asarray(one.measurements.value)
        found["truth"] = np.asarray(arbitrary_path(found["arrival"]))
    return found


def _study_arrays(squared: dict[str, Any], example: dict[str, Any]) -> xr.Dataset:
    metres, names = {"units": "m"}, list(REGIMES)
    tracks = np.stack([example[name] for name in names])

    def along(x: np.ndarray, **attrs: str) -> xr.DataArray:
        return xr.DataArray(x, dims=("arrival", "axis")[: x.ndim], attrs=attrs)

    return xr.Dataset(
        {
            "rmse_of_run": xr.DataArray(
                np.sqrt(np.stack([squared[name]["squared_error"] for name in names])),
                dims=("regime", "run"),
                attrs=metres,
            ),
            "estimate": xr.DataArray(tracks, dims=("regime", "arrival", "axis"), attrs=metres),
            "truth_at_arrival": along(example["truth"], **metres),
            "measured": along(example["measured"], **metres),
            "validity_time": along(example["time"], units="s"),
            "sensor": along(example["sensor"]),
        }
    ).assign_coords(
        regime=names,
        lag=("regime", [lag for lag, _ in REGIMES.values()], {"units": "s"}),
        arrival=("arrival", example["arrival"], {"units": "s"}),
        axis=["east", "north"],
    )
