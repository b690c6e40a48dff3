"""Comparing a measurement with what was expected of it, and refusing what is not a number."""

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from ewif_jax import checks
from ewif_jax.fast.small import matmul
from ewif_jax.fast.sparse import Matrix, dense
from ewif_jax.kernels import gaussian, symmetric
from ewif_jax.models import Model, predict_measurement
from ewif_jax.types import Info, Measurement, Params, Status


class Compared(NamedTuple):
    """A measurement seen as one of the present state: difference (m,), measured minus predicted,
    H (m, n), noise covariance R (m, m), and mask (m,) of what is present."""

    difference: Array
    H: Array | Matrix
    R: Array
    mask: Array


def compared(model: Model, params: Params, mean: Array, measurement: Measurement) -> Compared:
    """A measurement at its time as it is seen from `mean` (n,) there."""
    predicted, H, R = predict_measurement(model, params, mean, measurement.sensor, measurement.time)
    checks.shape("measurement.value", measurement.value, (H.shape[0],))
    difference = model.residual(measurement.value, predicted, measurement.sensor)
    return Compared(difference, H, R, measurement.mask)


def info_of(innovation: gaussian.Innovation, mask: Array, accepted: Array | bool = True) -> Info:
    """The `Info` of a measurement taken to be in sequence; the contract adds the rest."""
    return Info(
        innovation.value,
        innovation.cov,
        gaussian.log_density(innovation, mask),
        jnp.zeros((), innovation.value.dtype),
        jnp.where(accepted, jnp.int32(Status.USED), jnp.int32(Status.REJECTED)),
    )


def are_finite(difference: Array, cov: Array, mask: Array) -> Array:
    """Whether an innovation (m,) and its covariance `cov` (m, m) are finite in the components that
    are present, () bool. Its density may be smaller than any float."""
    cov = gaussian.mask_cov(cov, mask)
    return jnp.all(jnp.isfinite(jnp.where(mask, difference, 0))) & jnp.all(jnp.isfinite(cov))


def sound(model: Model, cov: Array, seen: Compared) -> tuple[Compared, Array]:
    """`seen` by a state of packed covariance `cov`, or nothing at all where innovation or log
    density would not be finite, and whether it is used, () bool.

    What is refused is zero before anything is computed from it, so that gradients stay finite.
    A linear model's measurements pass unseen: a gain that looks at values could not be shared by a
    batch of runs. Their values are checked by `run` and `step`.
    """
    difference, H, R, mask = seen
    if model.linear is not None:
        return seen, jnp.asarray(True)
    H = jnp.where(mask[:, None], dense(H), 0)
    good = are_finite(difference, matmul(symmetric.rows(H, cov), H.T) + R, mask)
    difference, H, R = (jnp.where(good, x, 0) for x in (difference, H, R))
    return Compared(difference, H, R, mask & good), good


def updated(model: Model, mean: Array, cov: Array, seen: Compared) -> tuple[Array, Array, Info]:
    """Mean and packed covariance after a measurement, with its `Info` (delay 0, status USED or
    REJECTED)."""
    (difference, H, R, mask), good = sound(model, cov, seen)
    mean, cov, innovation = gaussian.update(mean, cov, difference, H, R, mask)
    return mean, cov, info_of(innovation, mask, good)
