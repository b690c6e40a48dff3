"""What one measurement says of the present state, as equations, and what of it is only rounding."""

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from ewif_jax import checks
from ewif_jax.fast.small import matmul, matvec
from ewif_jax.fast.sparse import Matrix, elementwise
from ewif_jax.kernels import cholesky
from ewif_jax.models import Model
from ewif_jax.models.linearise import affine_flow, noise_at, observation, predicted_value
from ewif_jax.types import Measurement, Params


def still_at_once(F: Array | Matrix, at_once: Array) -> Array | Matrix:
    """F, the identity to the last bit over no time: where nothing is known of a direction yet, the
    rounding of a zero would be taken for what a measurement says of it. Where the zeros of F are
    known it is that already."""
    if isinstance(F, Matrix):
        return F
    return jnp.where(at_once, jnp.eye(F.shape[0], dtype=F.dtype), F)


class Sight(NamedTuple):
    """A measurement of any time as one of the present state: H A (m, n), measured minus predicted
    (m,), R (m, m), and how large the terms of H A are, (m, n), None where it is known which are
    zero; zeros where masked."""

    seen: Array
    difference: Array
    R: Array
    size: Array | None


def sight(model: Model, params: Params, mean: Array, now: Array, measurement: Measurement) -> Sight:
    """The measurement as `mean` (n,) at time `now` sees it."""
    dtype = mean.dtype
    mask = measurement.mask
    A, c = affine_flow(model, params, now, measurement.time, dtype)
    H, R = observation(model, params, measurement.sensor, measurement.time, dtype)
    checks.shape("measurement.value", measurement.value, (H.shape[0],))
    checks.shape("H", H, ("m", mean.shape[0]))
    checks.shape("R", R, (H.shape[0],) * 2)
    A = still_at_once(A, measurement.time == now)
    there = matvec(A, mean)
    there = there if c is None else there + c
    if model.jitter is not None:
        R = noise_at(model, params, there, measurement.sensor, measurement.time)
    predicted = predicted_value(model, params, H, there, measurement.sensor, measurement.time)
    difference = model.residual(measurement.value, predicted, measurement.sensor)
    seen = jnp.where(mask[:, None], matmul(H, A), 0)
    size = None
    if not isinstance(A, Matrix):
        sizes = matmul(elementwise(jnp.abs, H), jnp.abs(A))
        size = jnp.where(mask[:, None], sizes, 0)
    return Sight(seen, jnp.where(mask, difference, 0), R, size)


def summed(unit: cholesky.Factor, sizes: Array) -> Array:
    """How large the terms (m, n) of whitened equations are, of which the terms were `sizes`."""
    eye = jnp.eye(sizes.shape[0], dtype=sizes.dtype)
    # Forward substitution with -|L| only adds: what comes out bounds the terms that may cancel in
    # L^-1 (H A), and rounding is judged by these and not by what is left of them.
    adding = jnp.where(eye > 0, 1, -jnp.abs(unit.lower))
    return cholesky.forward(unit._replace(lower=adding), sizes)


class Noise(NamedTuple):
    """R = L diag(variances) L': the unit lower triangular L, and variances (m,)."""

    unit: cholesky.Factor
    variances: Array


def noise_of(R: Array, seen: Array, exact: bool = False) -> tuple[Noise, Array]:
    """R taken apart, and whether the measurement is any good."""
    m = R.shape[0]
    found = cholesky.factor(R)
    diagonal = jnp.diagonal(found.lower)
    eye = jnp.eye(m, dtype=R.dtype)
    unit = jnp.where(eye > 0, 1, matmul(found.lower, eye * found.reciprocal[None]))
    fine = jnp.all(jnp.isfinite(seen))
    psd = jnp.all(jnp.isfinite(R)) & jnp.all(jnp.diagonal(R) >= 0)
    allowed = psd if exact else psd & found.full_rank
    factor = cholesky.Factor(unit, jnp.ones(m, R.dtype), found.full_rank)
    return Noise(factor, jnp.square(diagonal)), fine & allowed
