"""The estimate that looks both ways against the filter and its fixed lag, on the same runs."""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ewif_jax.batch import Step, run_batch
from ewif_jax.estimators.ewif import ewif
from ewif_jax.models import Model
from ewif_jax.monte_carlo import Simulation
from ewif_jax.smoothers.fixed_lag_ewif import fixed_lag_ewif
from ewif_jax.smoothers.two_sided_ewif import two_sided_ewif
from ewif_jax.study.shared.late import paired, rmse_of
from ewif_jax.types import Measurement

RANKS = (1, 2, 1, 2)
"""of the fields of a `Measurement` that all runs share; one more where each run has its own"""


def two_sided_errors(
    model: Model, tau: float, batch: Simulation, *, chunk: int = 250
) -> np.ndarray:
    """Mean squared error (R,) of `two_sided_ewif`, with all the measurements of a run, at the times
    of its reports; truth that is NaN does not count."""
    runs = batch.measurements.value.shape[0]
    spread = [x.ndim > rank for x, rank in zip(batch.measurements, RANKS, strict=True)]
    report = batch.measurements.time if batch.times is None else batch.times
    truth = np.asarray(batch.truth)
    found = []
    for k in range(0, runs, chunk):
        some = slice(k, k + chunk)
        part = [x[some] if own else x for x, own in zip(batch.measurements, spread, strict=True)]
        times = report[some] if report.ndim == 2 else report
        means = _smoothed_means(model, jnp.asarray(tau), Measurement(*part), times)
        exact = truth[some] if truth.ndim == 3 else truth
        found.append(_mean_square(np.asarray(means), exact))
    return np.concatenate(found)


@partial(jax.jit, static_argnames="model")
def _smoothed_means(model: Model, tau: Array, measurements: Measurement, times: Array) -> Array:
    """Estimates (R, K, n) at `times` (K,) or (R, K)."""
    own = [x.ndim > rank for x, rank in zip(measurements, RANKS, strict=True)]
    axes: Any = Measurement(*(0 if each else None for each in own))  # type: ignore[arg-type]

    def one_run(stream: Measurement, times: Array) -> Array:
        return two_sided_ewif(model, None, stream, tau=tau, times=times).mean

    return jax.vmap(one_run, (axes, 0 if times.ndim == 2 else None))(measurements, times)


def _mean_square(means: np.ndarray, truth: np.ndarray) -> np.ndarray:
    squares = np.sum((means[..., : truth.shape[-1]] - truth) ** 2, -1)
    return np.nanmean(squares, axis=1)


def compared_means(
    model: Model, taus: np.ndarray, batch: Simulation, *, steps: int
) -> dict[str, np.ndarray]:
    """Mean squared errors (V, R) of the filter, of its fixed lag of `steps` samples, and of the
    two-sided estimate, for V decay times, at the same times: those that all three report. The
    samples are at the times of `batch.measurements`, equally spaced and shared by the runs."""
    time = batch.measurements.time
    last = time.shape[0] - steps
    lag = float(time[steps] - time[0])
    truth = np.broadcast_to(
        batch.truth, (*batch.measurements.value.shape[:2], batch.truth.shape[-1])
    )
    filters = {
        "filter": (ewif(model, lambda p: p["tau"]), 0),
        "fixed lag": (fixed_lag_ewif(model, lambda p: p["tau"], lag=lag), steps),
    }
    until = batch._replace(truth=truth[:, :last], times=time[:last])
    found: dict[str, list[np.ndarray]] = {name: [] for name in (*filters, "two-sided")}
    for tau in taus:
        for name, (estimator, behind) in filters.items():
            means = run_batch(
                estimator,
                {"tau": jnp.asarray(tau)},
                batch.measurements,
                prior=None,
                t0=0.0,
                observe=_seen_mean,
                devices=1,
            )
            at = np.asarray(means)[:, behind : behind + last]
            found[name].append(_mean_square(at, truth[:, :last]))
        found["two-sided"].append(two_sided_errors(model, tau, until))
    return {name: np.stack(squares) for name, squares in found.items()}


def _seen_mean(step: Step, _: Any) -> Array:
    """One function for all decay times: another would be compiled again."""
    return step.mean


def table_rows(squared: dict[str, np.ndarray], taus: np.ndarray, used: int) -> list[dict[str, Any]]:
    """The rows of a table: errors with tau = taus[used], with each method's best of `taus`, and how
    much the two-sided estimate, also with its best, is better on the same runs."""
    best = {name: int(np.argmin(x.mean(1))) for name, x in squared.items()}
    both = squared["two-sided"]
    return [
        {
            "estimate": name,
            f"RMSE, tau = {taus[used]:g} s": rmse_of(x[used]),
            "best tau [s]": f"{taus[best[name]]:.3g}",
            "RMSE there": rmse_of(x[best[name]]),
            "above the two-sided": None
            if name == "two-sided"
            else paired(x[best[name]], both[best["two-sided"]]),
        }
        for name, x in squared.items()
    ]
