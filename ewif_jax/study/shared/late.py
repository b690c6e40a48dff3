"""What the studies of late measurements share: sweeps over settings on the same runs, and their
errors."""

from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ewif_jax.batch import Step
from ewif_jax.estimators.kalman import kalman
from ewif_jax.fast.compiling import array
from ewif_jax.fast.layout import equal_parts
from ewif_jax.models import Model
from ewif_jax.monte_carlo import Scenario, Simulation
from ewif_jax.scores import Score, average, scored, squared_error
from ewif_jax.study.shared.experiment import Measured
from ewif_jax.types import Estimator, Measurement, Numbers, Status


def late_used(step: Step, truth: Array, mask: Array) -> Array:
    """1 for a late measurement that was used."""
    del truth, mask
    return (step.info.status == Status.LATE_USED).astype(step.mean.dtype)


def too_late(step: Step, truth: Array, mask: Array) -> Array:
    """1 for a measurement that was too late."""
    del truth, mask
    return (step.info.status == Status.TOO_LATE).astype(step.mean.dtype)


DROPPED = "#b35806"
"""colour of what drops late measurements"""

METRICS: dict[str, Score] = {
    "squared_error": squared_error,
    "late_used": late_used,
    "too_late": too_late,
}


def sweep(
    estimator: Estimator,
    settings: Mapping[str, Any],
    batch: Simulation,
    *,
    chunk: int | None = None,
    progress: Callable[[int, int], None] | None = None,
    **setting: Any,
) -> dict[str, np.ndarray]:
    """Averages over the arrivals (V, R) of `METRICS`, for V parameter settings on the same R runs.

    `settings` are parameters by name, (V,) or (V, R) each. All settings that fit into `chunk`
    (1024) runs are one batch. `setting` (prior, t0, clock) as in `run_batch`.
    """
    runs = batch.truth.shape[0]
    full = {
        name: np.broadcast_to(np.reshape(v, (len(v), -1)), (len(v), runs))
        for name, v in settings.items()
    }
    count = len(next(iter(full.values())))
    parts = -(-count // max((chunk or 1024) // runs, 1))
    size = -(-count // parts)
    found = []
    for index in equal_parts(count, size):
        some = {name: v[index].reshape(-1) for name, v in full.items()}
        found.append(_average_errors(estimator, some, batch, setting))
        if progress is not None:
            progress(int(index[-1]) + 1, count)
    return {name: np.concatenate([f[name] for f in found])[:count] for name in METRICS}


def history_needed(measurements: Measurement) -> int:
    """How many update times a history must hold so that no measurement of a batch is too late."""
    times = np.asarray(measurements.time)
    newest = np.maximum.accumulate(times, axis=1)
    needed = 1
    for time, top in zip(times, newest, strict=True):
        records = np.unique(top)
        behind = np.searchsorted(records, top) - np.searchsorted(records, time, side="right")
        needed = max(needed, int(behind.max()) + 1)
    return needed


def rmse_of(squared: np.ndarray) -> Measured:
    """Root of the mean of per-run mean squares, with its standard error (delta method)."""
    value = float(np.sqrt(np.mean(squared)))
    error = float(np.std(squared, ddof=1) / np.sqrt(squared.size))
    return Measured(value, error / (2 * value))


def mean_of(values: np.ndarray) -> Measured:
    """Mean of independent values, with its standard error."""
    return Measured(float(values.mean()), float(values.std(ddof=1) / np.sqrt(values.size)))


def paired(squared: np.ndarray, other: np.ndarray) -> Measured:
    """Difference of the RMSE of two methods on the same runs, run by run."""
    return mean_of(np.sqrt(squared) - np.sqrt(other))


def rmses_of(squared: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """`rmse_of` of every row (V, R): values and standard errors (V,)."""
    found = np.asarray([rmse_of(row) for row in squared])
    return found[:, 0], found[:, 1]


def _average_errors(
    estimator: Estimator, settings: dict[str, np.ndarray], batch: Simulation, setting: Any
) -> dict[str, np.ndarray]:
    runs = batch.truth.shape[0]
    count = next(iter(settings.values())).size // runs

    def tiled(x: Array) -> np.ndarray:
        return np.tile(np.asarray(x), (count,) + (1,) * (x.ndim - 1))

    many = jax.tree.map(tiled, batch)
    scores = scored(
        estimator,
        settings,
        many.measurements,
        many.truth,
        scores=METRICS,
        times=many.times,
        params_per_run=True,
        **setting,
    )
    return {name: np.asarray(average(x, 1)).reshape(count, runs) for name, x in scores.items()}


def exact_late(
    model: Model, scenario: Scenario, batch: Simulation, window: int, effort: int = 4_000_000
) -> np.ndarray:
    """Mean squared error (R,) of the exact estimate from everything that has arrived.

    Each estimate is a Kalman filter of its own, over the last `window` measurements in order of
    validity time, those that have not arrived masked out. It is evaluated at equally spaced
    arrivals, as many as `effort` filter steps allow (50 at least). Measurement times increase
    in every run (in order of validity) and all have one component.
    """
    runs, steps = batch.truth.shape[:2]
    window = min(window, steps)
    count = min(max(effort // (runs * window), 50), steps)
    at = np.unique(np.linspace(0, steps - 1, count).astype(int))
    time = np.asarray(batch.measurements.time)
    order = np.argsort(np.argsort(time, axis=1), axis=1)
    newest = np.maximum.accumulate(order, axis=1)[:, at]
    place = newest[..., None] + np.arange(1 - window, 1)
    arrival = np.argsort(order, axis=1)
    rows = np.arange(runs)[:, None, None]
    source = arrival[rows, np.maximum(place, 0)]
    present = (place >= 0) & (source <= at[:, None])

    def windows(x: Numbers) -> Array:
        chosen = np.asarray(x)[rows, source]
        return array(chosen.reshape(-1, window, *chosen.shape[3:]))

    times, values = batch.measurements[:2]
    stream = Measurement(
        windows(times),
        windows(values),
        jnp.zeros(window, jnp.int32),
        jnp.asarray(present.reshape(-1, window, 1)),
    )
    truth = np.full((runs * at.size, window, batch.truth.shape[2]), np.nan)
    truth[:, -1] = np.asarray(batch.truth)[:, at].reshape(runs * at.size, -1)
    scores = scored(
        kalman(model),
        {},
        stream,
        truth,
        scores={"squared_error": squared_error},
        prior=scenario.prior,
        t0=scenario.t0,
    )
    return np.asarray(scores["squared_error"][:, -1]).reshape(runs, at.size).mean(1)
