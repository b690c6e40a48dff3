"""What no unbiased estimator of a motion without noise can beat: the Cramer-Rao bound."""

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ewif_jax import checks
from ewif_jax.kernels import cholesky, gaussian
from ewif_jax.latency import on_time
from ewif_jax.models import Model
from ewif_jax.models.components import check_components, existing
from ewif_jax.models.linearise import noise_at
from ewif_jax.streams import cast, checked_stream, float_dtype
from ewif_jax.types import Measurement, Numbers, Params, State


def crlb(
    model: Model,
    params: Params,
    measurements: Measurement,
    *,
    state: State,
    time: Numbers,
    weight: Callable[..., Array] | None = None,
    information: Numbers = None,
) -> Array:
    r"""The bound (n, n) on the error covariance at `time`, when nothing but the start is unknown.

    .. math::
        \mathrm{CRLB}(t_k) = \Big( J_0 + \sum_l W_{l,k}^2
            A_{l,k}' H_l' R_l^{-1} H_l A_{l,k} \Big)^{-1}

    with :math:`H_l A_{l,k}` the derivative of measurement l with respect to the state at
    :math:`t_k`. With `weight` it is the bound under the noise model (6) of Shulami & Sigalov, in
    which the variance of an old measurement grows by :math:`1/W^2`: by their Theorem 6 it is the
    covariance that `ewif` reports. Without, it is the bound for the true noise.

    Args:
        model: any `Model` that can be moved from `time` to each measurement; its process noise is
            ignored.
        params: what its parameters are read from.
        measurements: T of them, of any times in any order; their values are not used.
        state: (n,) true state at `time`, where a nonlinear model is linearised.
        time: seconds.
        weight: W(params, t_measurement, t_state), or None for 1.
        information: (n, n) prior information matrix at `time`, or None for nothing.

    Returns:
        (n, n); NaN if the measurements do not determine the state, or an R that is not known is
        singular.

    Reduces to: the covariance of `kalman` without process noise; that of `ewif` with its weight.

    Raises:
        ValueError: unusable measurements, state or time; a known R that is singular (an exact
            measurement has no finite information: give it a small variance).
    """
    checked_stream(measurements)
    check_components(model, measurements)
    measurements = on_time(model, None, params, measurements)
    checks.finite("time", time)
    dtype = float_dtype(state)
    check_finite_information(model, params, measurements)
    stream, time = cast(existing(model, measurements), dtype), jnp.asarray(time, dtype)
    state = jnp.asarray(state, dtype)
    checks.shape("state", state, ("n",))
    n = state.shape[0]
    if information is not None:
        checks.shape("information", information, (n, n))
        checks.psd("information", information)
        information = jnp.asarray(information, dtype)
    return _bound_along(model, weight, params, stream, state, time, information)


def check_finite_information(model: Model, params: Params, measurements: Measurement) -> None:
    """Refuses a known R that is singular in components that are there: of each sensor and mask, at
    its first measurement."""
    given = (params, measurements.time, measurements.sensor, measurements.mask)
    if any(checks.concrete_value(x) is None for x in jax.tree.leaves(given)):
        return
    time, sensor, mask = (np.asarray(x) for x in given[1:])
    _, rows = np.unique(np.column_stack([sensor, mask]), axis=0, return_index=True)
    for row in rows[mask[rows].any(-1)]:
        with jax.ensure_compile_time_eval():
            R = np.asarray(model.measurement_cov(params, np.int32(sensor[row]), time[row]), float)
        checks.require(
            _full_rank(R[np.ix_(mask[row], mask[row])]),
            "R",
            "a positive definite covariance: an exact measurement has no finite information (give "
            "it a small variance)",
            f"{R.tolist()} at row {row}",
        )


def _full_rank(R: np.ndarray) -> bool:
    """Whether a covariance in any units has an inverse; NaN is left to others."""
    variances = np.diagonal(R)
    if np.isnan(R).any() or variances.min() <= 0:
        return bool(np.isnan(R).any())
    units = np.sqrt(variances)
    least = np.linalg.eigvalsh(R / units / units[:, None]).min()
    return bool(least > len(R) * np.finfo(float).eps)


@partial(jax.jit, static_argnames=("model", "weight"))
def _bound_along(
    model: Model,
    weight: Callable[..., Array] | None,
    params: Params,
    stream: Measurement,
    state: Array,
    time: Array,
    information: Array | None,
) -> Array:
    def one_measurement(measurement: Measurement) -> Array:
        sensor, mask = measurement.sensor, measurement.mask

        def seen(x: Array) -> Array:
            there = model.transition(params, x, time, measurement.time)
            return jnp.asarray(model.observe(params, there, sensor, measurement.time), state.dtype)

        there = jnp.asarray(model.transition(params, state, time, measurement.time), state.dtype)
        R = noise_at(model, params, there, sensor, measurement.time)
        noise = cholesky.factor(gaussian.mask_cov(R, mask))
        white = cholesky.forward(noise, jnp.where(mask[:, None], jax.jacfwd(seen)(state), 0))
        w = 1.0 if weight is None else weight(params, measurement.time, time)
        # An exact measurement has no finite information; a skipped pivot would give it none.
        return jnp.where(noise.full_rank, jnp.square(w) * white.T @ white, jnp.nan)

    total = jnp.sum(jax.vmap(one_measurement)(stream), 0)
    total = total if information is None else total + information
    f = cholesky.factor(total)
    return jnp.where(f.full_rank, cholesky.inverse(f), jnp.nan)
