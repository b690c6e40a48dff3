"""Covariance form: mean and covariance, moved through the model or its Jacobians."""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from ewif_jax.fast.batched import largest
from ewif_jax.fast.sparse import Matrix, apart, with_zeros
from ewif_jax.kernels import cholesky, symmetric
from ewif_jax.models import Model, predict_state
from ewif_jax.recursions.contract import Recursion, estimator_from
from ewif_jax.recursions.innovations import compared, updated
from ewif_jax.types import Estimator, Gaussian, Info, Measurement, Params, RandomKey


class CovarianceState(NamedTuple):
    """time (), mean (n,), cov: the upper triangle of the covariance, row by row."""

    time: Array
    mean: Array
    cov: Array


def covariance_form(
    model: Model, method: str, inflation: Callable[..., Array] | None = None
) -> Estimator:
    """The estimator of `covariance_recursion`."""
    return estimator_from(covariance_recursion(model, method, inflation))


def covariance_recursion(
    model: Model, method: str, inflation: Callable[..., Array] | None = None
) -> Recursion:
    """The Kalman recursion with the model's matrices, or with its Jacobians at the mean.

    `inflation(params, t0, t1)` multiplies F P F' before Q is added. Over one interval it is at most
    1 / eps: an old estimate then weighs less than rounding against the same amount of new data,
    while anything larger would drown R in the rounding of P and leave a P that is not a covariance.
    Over many intervals it saturates where the largest variance reaches the square root of the
    largest float, so that "knows nothing" never becomes infinity. What an interval forgets, it
    forgets down to rounding: the variances grow by that share of 8 n eps more than the rest, which
    keeps the covariance of a single direction a covariance.
    """

    def start(params: Params, prior: Gaussian, t0: Array, key: RandomKey) -> CovarianceState:
        del params, key
        return CovarianceState(t0, prior.mean, symmetric.pack(prior.cov))

    def move(params: Params, state: CovarianceState, time: Array) -> CovarianceState:
        mean, F, Q = predict_state(model, params, state.mean, state.time, time)
        cov = symmetric.congruence(F, state.cov)
        if inflation is not None:
            cov = _inflated_cov(cov, inflation(params, state.time, time))
        return CovarianceState(time, mean, cov + symmetric.pack(Q))

    def measure_now(
        params: Params, state: CovarianceState, measurement: Measurement
    ) -> tuple[CovarianceState, Info]:
        mean, cov, info = measure(model, params, state.mean, state.cov, measurement)
        return CovarianceState(state.time, mean, cov), info

    def estimate(params: Params, state: CovarianceState) -> Gaussian:
        del params
        return Gaussian(state.mean, symmetric.unpack(symmetric.no_negative(state.cov)))

    return Recursion(method, start, move, measure_now, estimate, keeps=True, model=model)


def measure(
    model: Model, params: Params, mean: Array, cov: Array, measurement: Measurement, still: int = 0
) -> tuple[Array, Array, Info]:
    """Mean and packed covariance after a measurement taken to be in sequence, with its `Info`
    (delay 0, status USED or REJECTED). The last `still` components of the state are not the
    model's, which neither moves nor sees them."""
    moving = mean[: mean.shape[0] - still]
    seen = compared(model, params, moving, measurement)
    seen = seen._replace(H=unseen(seen.H, still))
    return updated(model, mean, cov, seen)


def unseen(H: Array | Matrix, still: int) -> Array | Matrix:
    """H (m, n) of a state with as many more components."""
    if not still:
        return H
    values, where = apart(H)
    if where is not None:
        where = tuple(row + (False,) * still for row in where)
    return with_zeros(jnp.pad(values, ((0, 0), (0, still))), where)


def _inflated_cov(cov: Array, factor: Array) -> Array:
    # Only the variances grow by the extra share: more variance and equal covariances keep a matrix
    # positive definite, where equal factors would keep it singular to rounding.
    factor = _saturated_factor(factor, cov)
    rows, cols = np.triu_indices(symmetric.order(cov))
    variances = jnp.asarray(rows == cols, cov.dtype)
    rounding = cholesky.negligible(symmetric.order(cov), cov.dtype) * (1 - 1 / factor)
    return cov * factor * (1 + rounding * variances)


def _saturated_factor(factor: Array, cov: Array) -> Array:
    factor = jnp.minimum(jnp.asarray(factor, cov.dtype), 1 / jnp.finfo(cov.dtype).eps)
    ceiling = jnp.sqrt(jnp.finfo(cov.dtype).max)
    # One factor for all elements, from the largest: elements cut off one by one would be no
    # covariance.
    top = largest(jnp.abs(cov))
    room = ceiling / jnp.where(top > 0, top, 1)
    return jnp.minimum(factor, jnp.maximum(room, 1))
