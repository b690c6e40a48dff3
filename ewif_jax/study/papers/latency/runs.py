"""What the study of latencies computes: fits, their errors, a grid, and the position's error."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ewif_jax.batch import run_batch
from ewif_jax.losses import log_likelihood
from ewif_jax.monte_carlo import Simulation
from ewif_jax.oosm.asd import asd
from ewif_jax.scenarios.three_clocks import LATENCIES, Q, three_clocks, three_clocks_model
from ewif_jax.study.shared.fits import Fits, fitted
from ewif_jax.tuning.second_order import standard_errors
from ewif_jax.types import Measurement, Numbers, Params

NAMES = ("log q", "latency of 1", "latency of 2")
TRUTH = np.asarray([np.log(Q), *LATENCIES[1:]])
START = np.asarray([np.log(10 * Q), 0.0, 0.0])
PAST = 12
"""states that the filter keeps: 2 s of three measurements a second, and what latencies move"""
STEPS = (0.5, 0.05, 0.05)
POINTS = (5, 13, 13)
"""of the grid around the truth: log q, and each latency in s"""
AT_ONCE = 50
ROWS = 180
"""measurements of a run; a cost is a mean over them"""
NORMAL_95 = 1.959964
"""standard errors on either side of an interval of 95 %"""


def latency_filter() -> Any:
    """Exact for late data; log q is parameter 0."""
    return asd(three_clocks_model(q=lambda p: jnp.exp(p[0])), PAST)


def clocks(p: Params) -> Array:
    """The latencies of all three sensors; the first clock is the reference."""
    return jnp.stack([jnp.zeros_like(p[1]), p[1], p[2]])


def told() -> dict[str, Any]:
    """The prior, the time it is of, and the latencies, as every entry takes them."""
    scenario = three_clocks()
    return {"prior": scenario.prior, "t0": scenario.t0, "latency": clocks}


def cost_of(p: Params, stream: Measurement) -> Array:
    """Minus the log likelihood of one run's measurements (T, ...), a row."""
    rows = stream.time.shape[0]
    return -log_likelihood(latency_filter(), p, stream, **told()) / rows


def fits_of(batch: Simulation, progress: Callable[[int, int], None]) -> Fits:
    """Log q and two latencies (R, 3) of each run, from its measurements alone."""
    return fitted(cost_of, START, batch.measurements, progress)


def fits_as_stamped(batch: Simulation, progress: Callable[[int, int], None]) -> Fits:
    """Log q (R, 1) where every stamp is believed."""

    def cost(x: Array, stream: Measurement) -> Array:
        return cost_of(jnp.concatenate([x, jnp.zeros(2, x.dtype)]), stream)

    return fitted(cost, START[:1], batch.measurements, progress)


def errors_of_fits(
    batch: Simulation, points: np.ndarray, progress: Callable[[int, int], None]
) -> np.ndarray:
    """Standard errors (R, 3) of each run's own fit, by the observed information."""
    estimator, found = latency_filter(), []
    for k, point in enumerate(points):
        stream = jax.tree.map(lambda x, k=k: x[k], batch.measurements)
        found.append(standard_errors(estimator, point, stream, **told()).errors)
        progress(k + 1, len(points))
    return np.stack(found)


def cramer_rao(batch: Simulation) -> np.ndarray:
    """The standard deviations (3,) that no unbiased estimate from one run goes below: the inverse
    of the information at the truth, averaged over runs."""
    estimator, total, runs = latency_filter(), np.zeros((3, 3)), len(batch.truth)
    for begin in range(0, runs, AT_ONCE):
        some = jax.tree.map(lambda x, k=begin: x[k : k + AT_ONCE], batch.measurements)
        total += np.linalg.inv(standard_errors(estimator, TRUTH, some, **told()).cov)
    return np.sqrt(np.diagonal(np.linalg.inv(total / runs)))


def grid_points() -> np.ndarray:
    """(5 * 13 * 13, 3)."""
    axes = [
        centre + step * (np.arange(count) - count // 2)
        for centre, step, count in zip(TRUTH, STEPS, POINTS, strict=True)
    ]
    return np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)


def grid_costs(batch: Simulation, progress: Callable[[int, int], None]) -> np.ndarray:
    """The cost (R, 845) of each run at every point of the grid."""
    priced = jax.jit(jax.vmap(cost_of, (0, None)))
    points, found = grid_points(), []
    for k in range(len(batch.truth)):
        stream = jax.tree.map(lambda x, k=k: jnp.asarray(x[k]), batch.measurements)
        found.append(np.asarray(priced(points, stream)))
        progress(k + 1, len(batch.truth))
    return np.stack(found)


def squared_errors(batch: Simulation, points: Numbers) -> np.ndarray:
    """Mean squared error (R,) of the position at all arrivals, with parameters (R, 3) of each
    run."""
    trace = run_batch(
        latency_filter(),
        points,
        batch.measurements,
        times=batch.times,
        params_per_run=True,
        **told(),
    )
    off = np.asarray(trace.mean)[..., :1] - np.asarray(batch.truth)
    return np.mean(np.square(off[..., 0]), 1)
