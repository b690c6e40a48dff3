"""Information form: an information matrix around a reference mean.

The estimate is mean + matrix^-1 vector. Keeping the vector relative to a reference that follows
the estimate (instead of the absolute matrix x mean) is what keeps float32 accurate, and a matrix
that is still singular needs no special case.
"""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from ewif_jax import checks
from ewif_jax.fast.batched import kernel, largest, total
from ewif_jax.fast.small import matmul, matvec
from ewif_jax.fast.sparse import transposed
from ewif_jax.kernels import cholesky, gaussian, symmetric
from ewif_jax.models import Model
from ewif_jax.models.linearise import affine_flow, observation, patterns, size
from ewif_jax.types import Gaussian, Info, Measurement


class InformationState(NamedTuple):
    """time (), mean (n,): the reference, matrix: upper triangle of the information matrix,
    vector (n,): information times (estimate - mean), zero as soon as the matrix has full rank."""

    time: Array
    mean: Array
    matrix: Array
    vector: Array


def start(model: Model, params: Any, prior: Gaussian | None, t0: Any) -> InformationState:
    """The state that knows the prior, or nothing."""
    checks.prior(prior)
    if prior is None:
        t0 = jnp.asarray(t0)
        t0 = t0 if jnp.issubdtype(t0.dtype, jnp.floating) else t0.astype(float)
        nothing = jnp.zeros(size(model, params, t0), t0.dtype)
        return InformationState(t0, nothing, symmetric.pack(jnp.diag(nothing)), nothing)
    checks.psd("prior.cov", prior.cov, definite=True)
    mean = jnp.asarray(prior.mean)
    matrix = cholesky.inverse(cholesky.factor(jnp.asarray(prior.cov, mean.dtype)))
    return InformationState(
        jnp.asarray(t0, mean.dtype), mean, symmetric.pack(matrix), jnp.zeros_like(mean)
    )


def transport(
    model: Model, params: Any, state: InformationState, time: Array, weight: Array | float
) -> InformationState:
    """The state at `time` without process noise: information times `weight`, in either direction.

    matrix <- weight A' matrix A and vector <- weight A' vector, with A from `time` back to the
    state's time.
    """
    dtype = state.mean.dtype
    F, c = affine_flow(model, params, state.time, time, dtype)
    checks.shape("F", F, (state.mean.shape[0],) * 2)
    A, _ = affine_flow(model, params, time, state.time, dtype)
    F_where, _ = patterns(model)
    back = transposed(F_where)
    mean = matvec(F, state.mean, F_where)
    return InformationState(
        time,
        mean if c is None else mean + c,
        weight * symmetric.congruence(A.T, state.matrix, back),
        weight * matvec(A.T, state.vector, back),
    )


def absorb(
    model: Model,
    params: Any,
    state: InformationState,
    measurement: Measurement,
    weight: Array | float,
) -> tuple[InformationState, Info]:
    """The state with a measurement of any time, its information times `weight`; `Info.status` is
    left at 0 for the caller to set."""
    seen, difference, R = _sight(model, params, state, measurement)
    matrix, vector = _gained(seen, difference, R, measurement.mask)
    updated = recentred(
        state._replace(matrix=state.matrix + weight * matrix, vector=state.vector + weight * vector)
    )
    return updated, _info(state, seen, difference, R, measurement, weight)


def contribution(
    model: Model, params: Any, state: InformationState, measurement: Measurement
) -> tuple[Array, Array]:
    """Packed information matrix and vector (around the reference) of one measurement alone."""
    seen, difference, R = _sight(model, params, state, measurement)
    return _gained(seen, difference, R, measurement.mask)


def times(packed: Array, x: Array) -> Array:
    """A packed matrix times a vector."""
    return symmetric.times(packed, x)


def recentred(state: InformationState) -> InformationState:
    """The same information around the estimate, if there is one."""
    cov, full_rank = symmetric.inverse(state.matrix)
    shift = symmetric.times(cov, state.vector)
    return state._replace(
        mean=jnp.where(full_rank, state.mean + shift, state.mean),
        vector=jnp.where(full_rank, 0, state.vector),
    )


def estimate(state: InformationState) -> Gaussian:
    """Mean and covariance; NaN while the information matrix is not of full rank."""
    cov, full_rank = symmetric.inverse(state.matrix)
    mean = state.mean + symmetric.times(cov, state.vector)
    return Gaussian(
        jnp.where(full_rank, mean, jnp.nan),
        jnp.where(full_rank, symmetric.unpack(cov), jnp.nan),
    )


def settled(state: InformationState) -> Gaussian:
    """The estimate of a state that is `recentred` whenever there is one: the reference itself."""
    cov, full_rank = symmetric.inverse(state.matrix)
    centred = full_rank & (largest(jnp.abs(state.vector)) == 0)
    return Gaussian(
        jnp.where(centred, state.mean, jnp.nan),
        jnp.where(full_rank, symmetric.unpack(cov), jnp.nan),
    )


def _sight(
    model: Model, params: Any, state: InformationState, measurement: Measurement
) -> tuple[Array, Array, Array]:
    """H A (m, n), measured minus predicted at the reference (m,), R (m, m); zeros where masked."""
    dtype = state.mean.dtype
    mask = measurement.mask
    A, c = affine_flow(model, params, state.time, measurement.time, dtype)
    H, R = observation(model, params, measurement.sensor, measurement.time, dtype)
    checks.shape("measurement.value", measurement.value, (H.shape[0],))
    checks.shape("H", H, ("m", state.mean.shape[0]))
    checks.shape("R", R, (H.shape[0],) * 2)
    F_where, H_where = patterns(model)
    there = matvec(A, state.mean, F_where)
    there = there if c is None else there + c
    difference = model.residual(measurement.value, matvec(H, there, H_where), measurement.sensor)
    seen = jnp.where(mask[:, None], matmul(H, A, H_where), 0)
    return seen, jnp.where(mask, difference, 0), R


def _gained(seen: Array, difference: Array, R: Array, mask: Array) -> tuple[Array, Array]:
    noise = cholesky.factor(gaussian.mask_cov(R, mask))
    rows = cholesky.forward(noise, seen)
    # Apart from the vector, the matrix depends on no data: a batch of runs may share it.
    return _squares(rows), _products(rows, cholesky.forward(noise, difference))


@kernel
def _squares(rows: Array) -> Array:
    """rows' rows, packed."""
    i, j = np.triu_indices(rows.shape[1])
    return total(r[i] * r[j] for r in rows)


@kernel
def _products(rows: Array, target: Array) -> Array:
    """rows' target."""
    return total(r * t[None] for r, t in zip(rows, target, strict=True))


def _info(
    state: InformationState,
    seen: Array,
    difference: Array,
    R: Array,
    measurement: Measurement,
    weight: Array | float,
) -> Info:
    mask = measurement.mask
    cov, known = symmetric.inverse(state.matrix)
    innovation = gaussian.innovate(
        difference - matvec(seen, symmetric.times(cov, state.vector)),
        seen,
        matmul(matmul(seen, symmetric.unpack(cov)), seen.T) + R / weight,
        mask,
    )
    used = known & jnp.any(mask)
    return Info(
        jnp.where(known | ~mask, innovation.value, jnp.nan),
        jnp.where(known, innovation.cov, jnp.nan),
        jnp.where(used, gaussian.log_density(innovation, mask), 0),
        state.time - measurement.time,
        jnp.zeros((), jnp.int32),
    )
