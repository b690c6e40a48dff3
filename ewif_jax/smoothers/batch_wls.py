"""Weighted least squares over all the data at once: what the recursive filters must agree with."""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array, lax

from ewif_jax import checks
from ewif_jax.fast.sparse import dense
from ewif_jax.kernels import cholesky, gaussian
from ewif_jax.kernels.triangular import triangularise
from ewif_jax.latency import on_time
from ewif_jax.models.components import existing
from ewif_jax.models.entry import (
    check_covariances_of,
    check_span,
    check_times,
    without_process_noise,
)
from ewif_jax.models.linearise import (
    affine_flow,
    need_known_noise,
    need_linear,
    need_reversible,
    observation,
    predicted_value,
)
from ewif_jax.models.model import Model
from ewif_jax.models.sensor_range import check_sensors
from ewif_jax.models.steps import whole_steps
from ewif_jax.recursions.invertible import refuse_exact
from ewif_jax.streams import cast, float_dtype, given
from ewif_jax.types import Gaussian, Measurement, Numbers, Params

Weight = Callable[[Any, Array, Array], Array]
REPORTS_AT_ONCE = 64


def batch_wls(
    model: Model,
    params: Params,
    measurements: Measurement,
    times: Numbers,
    *,
    weight: Weight,
    prior: Gaussian | None = None,
    t0: Numbers = None,
) -> Gaussian:
    r"""The weighted least-squares estimate at each report time, from all the measurements.

    .. math::
        \hat x_k &= P_k \sum_l A_{l,k}' H_l' W_{l,k} R_l^{-1} W_{l,k}' (y_l - H_l c_{l,k}) \quad (8)
        \\
        P_k &= \Big( \sum_l A_{l,k}' H_l' W_{l,k} R_l^{-1} W_{l,k}' H_l A_{l,k} \Big)^{-1} \quad (9)

    Shulami & Sigalov, Theorems 1 and 2, with x_l = A x_k + c. Measurements before and after t_k
    count alike, and any scalar weight will do: it need not be a semigroup (11c). Solved by
    orthogonal triangularisation of the whitened rows and one step of refinement, so the condition
    number is not squared.

    Args:
        model: a linear `Model`; its process noise is ignored.
        params: what its parameters are read from; differentiable.
        measurements: T measurements in any order.
        times: (K,) seconds, when to estimate; any order.
        weight: W(params, t_l, t_k) -> (), the *square root* of the factor on the information of
            time t_l at time t_k. exp(-(t_k - t_l) / 2 tau) is the EWIF (12).
        prior: a measurement of the whole state at t0, weighted like the others; or None.
        t0: its time in seconds, needed with a prior.

    Returns:
        `Gaussian`: mean (K, n) and cov (K, n, n); NaN at times whose weighted measurements do not
        determine the state. cov is (9), not the covariance of the error under model (3).

    Raises:
        ValueError: an unusable stream or prior, a prior without t0, a model that is not linear.

    Reduces to: `ewif` at t_k = the newest time, for its weight; Savitzky-Golay for a polynomial
        model and W = 1 inside a window (5).
    """
    need_linear(model, "batch_wls")
    need_reversible(model, "batch_wls")
    need_known_noise(model, "batch_wls")
    params, measurements, prior, t0, times = given(params, measurements, prior, t0, times)
    measurements = on_time(model, None, params, measurements)
    checks.require(times is not None, "times", "when to estimate, (K,) seconds", None)
    check_sensors(model, params, None, measurements)
    refuse_exact(model, params, checks.with_dtype(measurements.time).min(), "batch_wls")
    checks.require(callable(weight), "weight", "a function (params, t_l, t_k)", repr(weight))
    dtype = float_dtype(measurements.value)
    check_times(model, measurements, t0, dtype, times, in_order=False)
    check_span(model, (measurements.time, t0), times)
    stamps = measurements.time
    seen_by = without_process_noise(model)
    check_covariances_of(seen_by, params, stamps, stamps, measurements.sensor)
    if prior is not None:
        checks.prior(prior)
        checks.psd("prior.cov", prior.cov, definite=True)
        checks.require(t0 is not None, "t0", "the time of the prior", None)
        t0 = jnp.asarray(t0, dtype)
        prior = Gaussian(jnp.asarray(prior.mean, dtype), jnp.asarray(prior.cov, dtype))
    seen = cast(existing(model, measurements), dtype)
    return _batch_wls(model, params, seen, jnp.asarray(times, dtype), weight, prior, t0)


@partial(jax.jit, static_argnames=("model", "weight"))
def _batch_wls(
    model: Model,
    params: Params,
    measurements: Measurement,
    times: Array,
    weight: Weight,
    prior: Gaussian | None,
    t0: Numbers,
) -> Gaussian:
    dtype = times.dtype

    def seen_from(time: Array, measurement: Measurement) -> Array:
        """Whitened, weighted rows (m, n + 1) of one measurement: what it says of x(time), and
        its value."""
        if model.steps is not None:
            whole = whole_steps(model.steps, time, measurement.time)
            measurement = measurement._replace(
                time=jnp.where(whole, measurement.time, time), mask=measurement.mask & whole
            )
        H, R = observation(model, params, measurement.sensor, measurement.time, dtype)
        checks.shape("measurement.value", measurement.value, (H.shape[0],))
        A, c = affine_flow(model, params, time, measurement.time, dtype)
        still = jnp.zeros(dense(H).shape[1], dtype) if c is None else c
        sensor, stamp = measurement.sensor, measurement.time
        offset_seen = predicted_value(model, params, H, still, sensor, stamp)
        target = model.residual(measurement.value, offset_seen, measurement.sensor)
        rows = jnp.where(measurement.mask[:, None], jnp.c_[dense(H) @ dense(A), target], 0)
        noise = cholesky.factor(gaussian.mask_cov(R, measurement.mask))
        white = jnp.where(noise.full_rank, cholesky.forward(noise, rows), jnp.nan)
        return _weighted_rows(weight(params, measurement.time, time), white)

    def believed_from(time: Array, prior: Gaussian) -> Array:
        A, c = affine_flow(model, params, time, t0, dtype)
        target = prior.mean if c is None else prior.mean - c
        spread = cholesky.factor(prior.cov)
        return _weighted_rows(
            weight(params, t0, time), cholesky.forward(spread, jnp.c_[dense(A), target])
        )

    def fitted_at(time: Array) -> Gaussian:
        rows = jax.vmap(partial(seen_from, time))(measurements)
        rows = rows.reshape(-1, rows.shape[-1])
        if prior is not None:
            rows = jnp.concatenate([rows, believed_from(time, prior)])
        return _least_squares(rows[:, :-1], rows[:, -1])

    # All rows are whitened anew for each report time: together they would take memory times
    # reports.
    return lax.map(fitted_at, times, batch_size=REPORTS_AT_ONCE)


def _weighted_rows(weight: Array, rows: Array) -> Array:
    """What counts nothing is left out, whatever its rows are."""
    return weight * jnp.where(weight == 0, 0, rows)


def _least_squares(rows: Array, target: Array) -> Gaussian:
    """argmin |rows x - target|^2 and the inverse of rows'rows, NaN where that is singular."""
    n = rows.shape[1]
    # The triangular root of [rows, target]'[rows, target] holds R' of the QR factorisation of rows
    # and Q' target under it: solving with R does not square the condition number as the normal
    # equations do (Golub & Van Loan, section 5.3).
    lower = triangularise(jnp.c_[rows, target].T)
    lower, turned = lower[:n, :n], lower[n, :n]
    pivot, length = jnp.diag(lower), jnp.sqrt(jnp.sum(rows**2, 0))
    full_rank = jnp.all(pivot > 8 * n * jnp.finfo(rows.dtype).eps * length)
    # Replaced before it is divided by, so that the NaN of an undetermined time has no NaN slope.
    lower = jnp.where(full_rank, lower, jnp.eye(n, dtype=rows.dtype))
    f = cholesky.Factor(lower, 1 / jnp.diag(lower), full_rank)
    mean = cholesky.backward(f, turned)
    # One step of iterative refinement takes out the rounding that Gram-Schmidt leaves in Q' target.
    mean = mean + cholesky.solve(f, rows.T @ (target - rows @ mean))
    return Gaussian(
        jnp.where(full_rank, mean, jnp.nan),
        jnp.where(full_rank, cholesky.inverse(f), jnp.nan),
    )
