"""What a method loses against the exact use of one late measurement: expected errors, no sampling."""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ewif_jax.estimator import run as run_filter
from ewif_jax.models import Model, constant_velocity, position_sensor, random_walk
from ewif_jax.oosm.a1 import a1
from ewif_jax.oosm.al1 import al1
from ewif_jax.oosm.asd import asd
from ewif_jax.oosm.b1 import b1
from ewif_jax.oosm.bl1 import bl1
from ewif_jax.oosm.drop_late import drop_late
from ewif_jax.types import Estimator, Gaussian, Measurement

SETTLED = 30
LAGS = (1, 2, 3, 5)
MOTIONS = {"random walk": (random_walk, 1), "white-noise acceleration": (constant_velocity, 2)}


def methods(model: Model) -> dict[str, Estimator]:
    """The exact one first."""
    every = max(LAGS)
    exact = asd(model, every)
    return {
        "exact": exact,
        "drop": drop_late(exact),
        "al1": al1(model, every),
        "bl1": bl1(model, every),
        "a1": a1(model),
        "b1": b1(model),
    }


def arrivals(lag: int) -> np.ndarray:
    """Times of a measurement every second until the filter has settled, and then of one that was
    taken in the middle of an interval, `lag` update times back."""
    return np.append(np.arange(1.0, SETTLED + 1), SETTLED - lag + 0.5)


def responses(estimator: Estimator, n: int, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """How the last estimate depends on the measured numbers (V, n, T), and its computed covariance
    (V, n, n), for V streams of times (V, T) and a prior N(0, I) at 0."""
    derivative, cov = _responses(estimator, n, jnp.asarray(times))
    return np.asarray(derivative), np.asarray(cov)


@partial(jax.jit, static_argnames=("estimator", "n"))
def _responses(estimator: Estimator, n: int, times: Array) -> tuple[Array, Array]:
    prior = Gaussian(jnp.zeros(n), jnp.eye(n))

    def last(values: Array, time: Array) -> tuple[Array, Array]:
        sensor, mask = jnp.zeros(time.size, jnp.int32), jnp.ones((time.size, 1), bool)
        stream = Measurement(time, values[:, None], sensor, mask)
        trace = run_filter(estimator, None, stream, prior=prior, t0=0.0)
        return trace.mean[-1], trace.cov[-1]

    return jax.vmap(jax.jacrev(last, has_aux=True), (None, 0))(jnp.zeros(times.shape[1]), times)


def expected_error(model: Model, n: int, times: np.ndarray, response: np.ndarray) -> np.ndarray:
    """E (x - x_hat)(x - x_hat)' (n, n) at the newest time of a linear estimate.

    State and measurements are written as matrices that multiply independent unit noises: the prior,
    the motion from each time to the next, and every measurement's own. `response` (n, T) is the
    estimate's derivative with respect to the measured numbers.
    """
    count = times.size
    sources = n + count * (n + 1)
    state, seen, now = np.eye(n, sources), np.zeros((count, sources)), 0.0
    for place, k in enumerate(np.argsort(times)):
        F, Q = (
            np.asarray(x)
            for x in (model.linear.F(None, now, times[k]), model.process_cov(None, now, times[k]))
        )
        state, now = F @ state, times[k]
        own = n + place * (n + 1)
        values, vectors = np.linalg.eigh(Q)
        state[:, own : own + n] += vectors * np.sqrt(np.maximum(values, 0))
        seen[k] = (np.asarray(model.linear.H(None, 0, now)) @ state)[0]
        seen[k, own + n] = np.sqrt(np.asarray(model.measurement_cov(None, 0, now))[0, 0])
    error = state - response @ seen
    return error @ error.T


def losses() -> list[dict[str, Any]]:
    """Rows of a table: expected mean square error of each method over that of the exact answer, and
    computed variance over true for Al1, all of the position."""
    rows = []
    for motion, (build, n) in MOTIONS.items():
        model = build(sensors=position_sensor(1.0), q=1.0)
        times = np.stack([arrivals(lag) for lag in LAGS])
        true, told = {}, {}
        for name, method in methods(model).items():
            response, told[name] = responses(method, n, times)
            true[name] = np.stack([
                expected_error(model, n, *one) for one in zip(times, response, strict=True)
            ])  # fmt: skip
        for i, lag in enumerate(LAGS):
            row: dict[str, Any] = {"motion": motion, "lags back": lag}
            best = true["exact"][i, 0, 0]
            row |= {name: float(x[i, 0, 0] / best) for name, x in true.items() if name != "exact"}
            row["al1, computed / true"] = float(told["al1"][i, 0, 0] / true["al1"][i, 0, 0])
            row["tr"] = [np.trace(x[i])/np.trace(true["exact"][i]) for x in true.values()]
            rows.append(row)
    return rows
