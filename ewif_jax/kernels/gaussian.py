"""The measurement update of a Gaussian: masked, singular-safe, Joseph-stabilised."""

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from ewif_jax.kernels import cholesky, symmetric
from ewif_jax.kernels.small import fence, matmul, matvec


class Innovation(NamedTuple):
    """What a measurement is compared with: value (m,), cov (m, m), its factor, cross (m, n) = H P."""

    value: Array
    cov: Array
    factor: cholesky.Factor
    cross: Array


def mask_cov(cov: Array, mask: Array) -> Array:
    """`cov` with identity rows and columns where `mask` is False."""
    both = mask[:, None] & mask[None, :]
    return jnp.where(both, cov, jnp.eye(cov.shape[0], dtype=cov.dtype))


def innovate(difference: Array, cross: Array, cov: Array, mask: Array) -> Innovation:
    """The innovation with absent components taken out: zero difference and gain, unit variance."""
    cov = mask_cov(cov, mask)
    return Innovation(
        jnp.where(mask, difference, 0),
        cov,
        cholesky.factor(cov),
        jnp.where(mask[:, None], cross, 0),
    )


def log_density(innovation: Innovation, mask: Array) -> Array:
    """log N(value; 0, cov) over the components that exist."""
    white = cholesky.forward(innovation.factor, innovation.value)
    count = jnp.sum(mask).astype(white.dtype)
    half_log_det = cholesky.half_log_det(innovation.factor)
    return -0.5 * (white @ white + count * jnp.log(2 * jnp.pi)) - half_log_det


def gain(innovation: Innovation) -> Array:
    """K = P H' S^-1, (n, m)."""
    return cholesky.solve(innovation.factor, innovation.cross).T


def joseph(packed: Array, gain: Array, cross: Array, H: Array, R: Array) -> Array:
    """(I - K H) P (I - K H)' + K R K', packed, in two low-rank steps.

    The second step uses H applied to the rounded result of the first, which is what makes the
    Joseph form forget rounding errors of the gain.
    """
    n = gain.shape[0]
    half = fence(symmetric.unpack(packed) - matmul(gain, cross))
    correction = matmul(gain, R) - matmul(half, H.T)
    return jnp.concatenate(
        [half[i, i:] + matvec(gain[i:], correction[i]) for i in range(n)]
    )


def update(
    mean: Array, packed: Array, difference: Array, H: Array, R: Array, mask: Array
) -> tuple[Array, Array, Innovation]:
    """Mean and packed covariance after a linear(ised) measurement, with the innovation.

    `difference` (m,) is measured minus predicted, H (m, n), R (m, m), mask (m,).
    """
    cross = matmul(H, symmetric.unpack(packed))
    innovation = innovate(difference, cross, matmul(cross, H.T) + R, mask)
    k = fence(gain(innovation))
    mean = mean + matvec(k, innovation.value)
    return mean, joseph(packed, k, innovation.cross, H, mask_cov(R, mask)), innovation
