"""What a method loses against the exact use of one late measurement, in expectation."""

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
from ewif_jax.oosm.b1 import b1
from ewif_jax.oosm.bl1 import bl1
from ewif_jax.types import Estimator, Gaussian, Measurement

SETTLED = 30
LAGS = (1, 2, 3, 5)
MOTIONS = {"random walk": (random_walk, 1), "white-noise acceleration": (constant_velocity, 2)}


def loss_methods(model: Model) -> dict[str, Estimator]:
    """The methods that take a late measurement in one step."""
    every = max(LAGS)
    return {"al1": al1(model, every), "bl1": bl1(model, every), "a1": a1(model), "b1": b1(model)}


def arrival_pairs(lag: int) -> np.ndarray:
    """Times of a measurement every second until the filter has settled, and then of one that was
    taken in the middle of an interval, `lag` update times back."""
    return np.append(np.arange(1.0, SETTLED + 1), SETTLED - lag + 0.5)


def responses(estimator: Estimator, n: int, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """How the last estimate of a linear filter depends on the measured numbers (V, n, T), and its
    computed covariance (V, n, n), for V streams of times (V, T) and a prior N(0, I) at 0."""
    response, cov = _impulse_responses(estimator, n, times)
    return np.asarray(response), np.asarray(cov)


@partial(jax.jit, static_argnames=("estimator", "n"))
def _impulse_responses(estimator: Estimator, n: int, times: Array) -> tuple[Array, Array]:
    prior = Gaussian(jnp.zeros(n), jnp.eye(n))

    def last(values: Array, time: Array) -> tuple[Array, Array]:
        sensor, mask = jnp.zeros(time.size, jnp.int32), jnp.ones((time.size, 1), bool)
        stream = Measurement(time, values[:, None], sensor, mask)
        trace = run_filter(estimator, None, stream, prior=prior, t0=0.0)
        return trace.mean[-1], trace.cov[-1]

    # What a linear filter makes of a single 1 is a column of its response.
    over_places = jax.vmap(last, (0, None), (1, 0))
    response, covs = jax.vmap(over_places, (None, 0))(jnp.eye(times.shape[1]), times)
    return response, covs[:, 0]  # which depends on no value


def sources(model: Model, n: int, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The state at the newest time (n, S) and the measurements (T, S), in the order of `times`, as
    multiples of S independent unit noises: the prior, the motion from each time to the next, and
    every measurement's own."""
    assert model.linear is not None
    count = times.size
    state = np.eye(n, n + count * (n + 1))
    seen, now = np.zeros((count, state.shape[1])), 0.0
    for place, k in enumerate(np.argsort(times)):
        t, own = times[k], n + place * (n + 1)
        state = np.asarray(model.linear.F(None, now, t)) @ state
        values, vectors = np.linalg.eigh(np.asarray(model.process_cov(None, now, t)))
        state[:, own : own + n] = vectors * np.sqrt(np.maximum(values, 0))
        seen[k] = (np.asarray(model.linear.H(None, 0, t)) @ state)[0]
        seen[k, own + n] = np.sqrt(np.asarray(model.measurement_cov(None, 0, t))[0, 0])
        now = t
    return state, seen


def relative_errors() -> list[dict[str, Any]]:
    """Rows of a table: the expected mean square error of each method over that of the exact answer,
    and Al1's computed variance over its true one, all of the position."""
    rows = []
    for motion, (build, n) in MOTIONS.items():
        model = build(sensors=position_sensor(1.0), q=1.0)
        times = np.stack([arrival_pairs(lag) for lag in LAGS])
        found = {name: responses(one, n, times) for name, one in loss_methods(model).items()}
        for i, lag in enumerate(LAGS):
            state, seen = sources(model, n, times[i])
            true = {
                name: _expected_square(state - response[i] @ seen)
                for name, (response, _) in found.items()
            }
            exact, dropped = _best_square(state, seen), _best_square(state, seen[:-1])
            rows.append(
                {
                    "motion": motion,
                    "lags back": lag,
                    "drop": dropped / exact,
                    **{name: mse / exact for name, mse in true.items()},
                    "al1, computed / true": float(found["al1"][1][i, 0, 0]) / true["al1"],
                }
            )
    return rows


def _expected_square(error: np.ndarray) -> float:
    """Expected square of the first component of an error (n, S)."""
    return float(error[0] @ error[0])


def _best_square(state: np.ndarray, seen: np.ndarray) -> float:
    """That of the best linear estimate, which is the exact one."""
    weights = np.linalg.solve(seen @ seen.T, seen @ state.T).T
    return _expected_square(state - weights @ seen)
