"""The arrowhead of Yoder et al., section 4.2 and Figs. 7-9: when a late measurement does harm."""

from typing import Any

import jax
import numpy as np
import xarray as xr

from ewif_jax.analysis.merit import maneuvering_index, random_walk_cutoff, random_walk_gain
from ewif_jax.estimator import run as run_filter
from ewif_jax.estimators.ewif import ewif
from ewif_jax.losses import rmse_loss
from ewif_jax.monte_carlo import Scenario, Simulation, simulate_batch
from ewif_jax.oosm.al1 import al1
from ewif_jax.oosm.selective import selective
from ewif_jax.scenarios.arrowhead import arrowhead, arrowhead_model
from ewif_jax.study.papers.arrowhead import figures as arrowhead_figures
from ewif_jax.study.shared.experiment import Experiment
from ewif_jax.study.shared.late import history_needed, paired, rmse_of, rmses_of, sweep
from ewif_jax.tuning import tune
from ewif_jax.types import Estimator, PyTree

Q, VARIANCE, RATIO = 20.0, 2000.0, 0.6
AT_STALE = 5
"""where `cutoffs` holds T_stale"""


def stale() -> float:
    """T_stale of eq. (8): 5.11 s."""
    return float(random_walk_cutoff(maneuvering_index(Q, VARIANCE, 1.0), ratio=RATIO))


def cutoffs() -> np.ndarray:
    """21 thresholds in seconds, from "drop what is late" to "use everything". Delays of the state
    are whole seconds, so each admits one more of them than the last."""
    return np.asarray([0.0, 2.0, 3.0, 4.0, 5.0, stale(), *range(7, 21), np.inf])


def arrowhead_al1(lag: int) -> Estimator:
    """Al1 with the random walk model, up to params["cutoff"] seconds."""
    return selective(al1(arrowhead_model(Q, VARIANCE), lag), lambda p: p["cutoff"])


def exponential_filter() -> Estimator:
    """The EWIF with the same motion and params["tau"]."""
    return ewif(arrowhead_model(0.0, VARIANCE), tau=lambda p: p["tau"])


def run(experiment: Experiment) -> None:
    """Simulates, filters with every threshold at once, and draws; see the module's first line."""
    quick = experiment.options.quick
    runs = experiment.size(30, 4)
    scenario = arrowhead(r=VARIANCE, steps=500 if quick else 10_000)
    with experiment.timed("simulation"):
        batch = simulate_batch(scenario, jax.random.split(experiment.key(0), runs))
        lag = history_needed(batch.measurements)
    found = experiment.piece(
        "thresholds", lambda: _cutoff_thresholds(experiment, scenario, batch, lag)
    )
    faded = experiment.piece("ewif", lambda: _ewif_errors(experiment, scenario, batch))
    squared, taus = found["squared_error"], faded["tau"]
    lines = [
        ("KF, late measurements dropped", squared[0], found["late_used"][0]),
        (
            f"selective Al1, T_stale = {stale():.2f} s",
            squared[AT_STALE],
            found["late_used"][AT_STALE],
        ),
        ("Al1, everything", squared[-1], found["late_used"][-1]),
        (
            f"EWIF, same gain (τ = {taus[0]:.2f} s)",
            faded["squared_error"][0],
            faded["late_used"][0],
        ),
        (f"EWIF, tuned (τ = {taus[1]:.2f} s)", faded["squared_error"][1], faded["late_used"][1]),
    ]

    def row(first: dict[str, Any], mse: np.ndarray, used: np.ndarray) -> dict[str, Any]:
        against = paired(mse, squared[-1])
        return {
            **first,
            "RMSE [m]": rmse_of(mse),
            "minus Al1 with everything [m]": against if against.error > 0 else None,
            "late used": f"{100 * used.mean():.0f} %",
        }

    rows = [row({"method": name}, mse, used) for name, mse, used in lines]
    by_cutoff = [
        row({"cut-off [s]": float(c)}, mse, used)
        for c, mse, used in zip(cutoffs(), squared, found["late_used"], strict=True)
    ]
    example = _example_laps(experiment, scenario, lag, float(taus[1]))
    experiment.arrays("arrowhead", _arrowhead_arrays(found, faded, example))
    experiment.figure("path", arrowhead_figures.path(example))
    experiment.figure("cutoff", arrowhead_figures.cutoff(cutoffs(), squared, stale(), lines))
    experiment.figure("lag", arrowhead_figures.east_end(example))
    experiment.table("cutoffs", "Selective Al1 by its cut-off", by_cutoff)
    experiment.table(
        "arrowhead",
        f"Arrowhead, {runs} runs of {batch.truth.shape[1]} measurements",
        rows,
        [f"Al1 keeps {lag} past times, which is enough for every delay that occurred."],
    )
    experiment.finish()


def _cutoff_thresholds(
    experiment: Experiment, scenario: Scenario, batch: Simulation, lag: int
) -> dict[str, Any]:
    label = "Al1, all thresholds"
    with experiment.timed(label), experiment.progress(label) as report:
        return sweep(
            arrowhead_al1(lag),
            {"cutoff": cutoffs()},
            batch,
            prior=scenario.prior,
            t0=0.0,
            chunk=experiment.options.chunk,
            progress=report,
        )


def _ewif_errors(experiment: Experiment, scenario: Scenario, batch: Simulation) -> dict[str, Any]:
    """Errors with the tau of the Kalman filter's steady gain, and with the tau that gradient
    descent finds on other runs."""
    quick, label, estimator = experiment.options.quick, "EWIF: tuning", exponential_filter()
    gain = random_walk_gain(maneuvering_index(Q, VARIANCE, 1.0))
    same = -1 / np.log1p(-float(gain))
    training = arrowhead(r=VARIANCE, steps=500 if quick else 1000)
    with experiment.timed(label), experiment.progress(label) as report:
        seen = simulate_batch(training, jax.random.split(experiment.key(1), 4 if quick else 16))
        loss = rmse_loss(estimator, seen.measurements, seen.truth, prior=None, t0=0.0)
        tuned = tune(loss, {"tau": same}, steps=30 if quick else 50, progress=report)
    with experiment.timed("EWIF"):
        taus = np.asarray([same, tuned.params["tau"]])
        scores = sweep(
            estimator, {"tau": taus}, batch, prior=None, t0=0.0, chunk=experiment.options.chunk
        )
    return {"tau": taus, **scores}


def _example_laps(
    experiment: Experiment, scenario: Scenario, lag: int, tau: float
) -> dict[str, np.ndarray]:
    """Three laps, tracked by each method: positions at the time of each report."""
    by_al1, by_ewif = arrowhead_al1(lag), exponential_filter()
    filters = {
        "KF": (by_al1, {"cutoff": 0.0}, scenario.prior),
        "selective Al1": (by_al1, {"cutoff": stale()}, scenario.prior),
        "Al1": (by_al1, {"cutoff": np.inf}, scenario.prior),
        "EWIF, tuned": (by_ewif, {"tau": tau}, None),
    }
    with experiment.timed("one realisation"):
        one = arrowhead(r=VARIANCE, steps=400).simulate(experiment.key(2))
        found = {"measured": np.asarray(one.measurements.value), "truth": np.asarray(one.truth)}
        for name, (estimator, params, prior) in filters.items():
            trace = run_filter(estimator, params, one.measurements, prior=prior, t0=0.0)
            found[name] = np.asarray(trace.mean)
        found["time"] = np.asarray(trace.time)
    return found


def _arrowhead_arrays(found: PyTree, faded: Any, example: dict[str, np.ndarray]) -> xr.Dataset:
    values, errors = rmses_of(found["squared_error"])
    metres = {"units": "m"}
    at = {"cutoff": ("cutoff", cutoffs(), {"units": "s"})}

    def by_cutoff(x: np.ndarray, **attrs: str) -> xr.DataArray:
        return xr.DataArray(x, dims=("cutoff", "run")[: x.ndim], coords=at, attrs=attrs)

    tracks = {
        name.replace(",", "").replace(" ", "_"): (("time", "axis"), x, metres)
        for name, x in example.items()
        if name != "time"
    }
    return xr.Dataset(
        {
            "rmse": by_cutoff(values, **metres),
            "rmse_se": by_cutoff(errors, **metres),
            "rmse_of_run": by_cutoff(np.sqrt(found["squared_error"]), **metres),
            "late_used": by_cutoff(found["late_used"], units="1"),
            "ewif_rmse_of_run": xr.DataArray(
                np.sqrt(faded["squared_error"]), dims=("tau", "run"), attrs=metres
            ),
            **tracks,
        }
    ).assign_coords(
        time=("time", example["time"], {"units": "s"}),
        tau=("tau", faded["tau"], {"units": "s"}),
        axis=["east", "north"],
    )
