"""Which decay time behaves like which process noise."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ewif_jax import checks
from ewif_jax.analysis.expected import expected_mse
from ewif_jax.estimator import run
from ewif_jax.estimators.ewif import ewif
from ewif_jax.estimators.information import information
from ewif_jax.models.model import Model
from ewif_jax.types import Estimator, Measurement, Params


class Case(NamedTuple):
    """A known truth to compare filters on: the noise-free stream, truth (T, k), the noise
    covariance as in `expected_mse`, and t0."""

    measurements: Measurement
    truth: Array
    noise_cov: Any
    t0: Any


def settled_gain(estimator: Estimator, params: Params, m: int, dt: float, steps: int) -> Array:
    """The filter's gain (n, m) after `steps` equally spaced measurements of m components, started
    from nothing: the derivative of the estimate by the last measurement; NaN without one."""
    dtype = jnp.asarray(0.0).dtype
    time = jnp.arange(1, steps + 1, dtype=dtype) * dt

    def last(value: Array) -> tuple[Array, Array]:
        values = jnp.zeros((steps, m), dtype).at[-1].set(value)
        stream = Measurement(time, values, jnp.zeros(steps, jnp.int32), jnp.ones((steps, m), bool))
        mean = run(estimator, params, stream, prior=None, t0=jnp.zeros((), dtype)).mean[-1]
        return mean, mean

    gain, mean = jax.jacfwd(last, has_aux=True)(jnp.zeros(m, dtype))
    # What says nothing says so whatever is measured: its derivative alone would be 0.
    return jnp.where(jnp.isnan(mean)[:, None], jnp.nan, gain)


def equivalent_tau(
    model: Model,
    params: Params = None,
    *,
    dt: float,
    case: Case | None = None,
    m: int = 1,
    steps: int = 1000,
    bounds: tuple[float, float] | None = None,
) -> float:
    r"""The tau in seconds with which the EWIF behaves like the Kalman filter of `model`.

    By equal steady gain (the relative difference of the two gain matrices is least; for a scalar
    random walk it vanishes at :math:`\tau = -\Delta t / \ln(1 - k)`), or, with a `case`, by equal
    expected mean square error along its truth, at the root nearest to the one of equal gain.
    Shulami & Sigalov, section V-C, ask for this tau.

    Args:
        model: linear, with the process noise in question.
        params: its parameters.
        dt: sampling interval in seconds.
        case: where to compare expected errors; None compares steady gains.
        m: number of measured components.
        steps: arrivals until a gain counts as steady (many tau / dt).
        bounds: search interval for tau in seconds; default (dt / 20, steps * dt / 10).

    Raises:
        ValueError: no tau in `bounds` has the same expected error (where the Kalman filter does
            better than any tau); the message names the tau that comes nearest.
    """
    checks.positive("dt", dt)
    low, high = bounds or (dt / 20, steps * dt / 10)
    exponential = ewif(model, tau=lambda p: p[0])
    noisy = information(model)
    target = settled_gain(noisy, params, m, dt, steps)

    def mismatch(tau: Array) -> Array:
        gain = settled_gain(exponential, (tau, params), m, dt, steps)
        return _relative_difference(gain, target)

    by_gain = _finest_minimum(mismatch, low, high)
    if case is None:
        return by_gain
    wanted = _mean_mse(noisy, params, case)
    return _nearest_root(
        lambda tau: _mean_mse(exponential, (tau, params), case) - wanted, low, high, by_gain
    )


def equivalent_process_noise(
    model: Model,
    tau: float,
    *,
    dt: float,
    params_of: Callable[[Array], Any],
    case: Case | None = None,
    m: int = 1,
    steps: int = 1000,
    bounds: tuple[float, float] = (1e-6, 1e6),
) -> float:
    """The process noise with which the Kalman filter of `model` behaves like the EWIF with `tau`.

    The inverse of `equivalent_tau`, by the same two criteria.

    Args:
        model: linear, its process noise a function of `params`.
        tau: decay time in seconds.
        dt: sampling interval in seconds.
        params_of: the `params` of the model for a process-noise parameter q, e.g.
            ``lambda q: {"q": q}``.
        case, m, steps: as in `equivalent_tau`.
        bounds: search interval for q.

    Raises:
        ValueError: no q in `bounds` has the same expected error; the message names the nearest.

    See also: `weighting_as_process_noise` and `weighting_as_input_noise`, Anderson's (5-16) and
    (4-7): the noise, another one at every step, that has exactly the gains of a weighted filter.
    """
    checks.positive("dt", dt)
    checks.positive("tau", tau)
    low, high = bounds
    exponential = ewif(model, tau=tau)
    noisy = information(model)
    some = params_of(jnp.asarray(low))
    target = settled_gain(exponential, some, m, dt, steps)

    def mismatch(q: Array) -> Array:
        gain = settled_gain(noisy, params_of(q), m, dt, steps)
        return _relative_difference(gain, target)

    by_gain = _finest_minimum(mismatch, low, high)
    if case is None:
        return by_gain
    wanted = _mean_mse(exponential, some, case)
    return _nearest_root(
        lambda q: _mean_mse(noisy, params_of(q), case) - wanted, low, high, by_gain
    )


def _relative_difference(gain: Array, target: Array) -> Array:
    """The sum of the squares of the relative differences of two gain matrices.

    A gain that should be 0 (of one axis of the plane for the other) has no relative difference: it
    counts beside the largest gain of its state.
    """
    largest = jnp.max(jnp.abs(target), 1, keepdims=True)
    rounding = 1e3 * float(jnp.finfo(target.dtype).eps)
    is_coupled = jnp.abs(target) > rounding * largest
    scale = jnp.where(is_coupled, target, jnp.where(largest > 0, largest, 1))
    return jnp.sum(jnp.square((gain - target) / scale))


def _mean_mse(estimator: Estimator, params: Params, case: Case) -> Array:
    mse = expected_mse(
        estimator,
        params,
        case.measurements,
        case.truth,
        noise_cov=case.noise_cov,
        prior=None,
        t0=case.t0,
    )
    return jnp.nanmean(mse)


def _finest_minimum(fn: Callable[[Array], Array], low: float, high: float) -> float:
    """The minimiser in [low, high] by ever finer logarithmic grids, all points at once."""
    evaluate = jax.jit(jax.vmap(fn))
    a, b = np.log(low), np.log(high)
    for _ in range(14):
        grid = np.linspace(a, b, 33)
        values = np.asarray(evaluate(jnp.exp(grid)))
        expected = "an interval in which the filter settles"
        got = f"no finite gain from {low:g} to {high:g} (more steps, or another dt or m?)"
        checks.require(np.isfinite(values).any(), "bounds", expected, got)
        best = int(np.nanargmin(values))
        a, b = grid[max(best - 1, 0)], grid[min(best + 1, 32)]
    return float(np.exp((a + b) / 2))


def _nearest_root(fn: Callable[[Array], Array], low: float, high: float, near: float) -> float:
    """The root in [low, high] nearest to `near` on a log scale."""
    evaluate = jax.jit(jax.vmap(fn))
    grid = np.linspace(np.log(low), np.log(high), 129)
    value = np.asarray(evaluate(jnp.exp(grid)))
    crossing = np.flatnonzero(np.sign(value[:-1]) * np.sign(value[1:]) <= 0)
    if crossing.size == 0:
        nearest = _finest_minimum(lambda x: jnp.abs(fn(x)), low, high)
        least = float(fn(jnp.asarray(nearest)))
        expected = f"a value from {low:g} to {high:g} with the same expected error"
        got = f"none; nearest is {nearest:.6g}, whose mean square error differs by {least:.3g}"
        checks.require(False, "case", expected, got)
    k = crossing[np.argmin(np.abs(grid[crossing] + grid[crossing + 1] - 2 * np.log(near)))]
    a, b, sign = grid[k], grid[k + 1], np.sign(value[k])
    for _ in range(9):
        fine = np.linspace(a, b, 33)
        value = np.asarray(evaluate(jnp.exp(fine)))
        j = int(np.argmax(np.sign(value) != sign))
        a, b = fine[max(j - 1, 0)], fine[j]
    return float(np.exp((a + b) / 2))
