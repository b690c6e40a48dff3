"""The measurement update of a Gaussian: masked, singular-safe, Joseph-stabilised."""

from collections.abc import Callable
from functools import cache
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from ewif_jax.fast.batched import kernel, total
from ewif_jax.fast.small import matmul
from ewif_jax.fast.sparse import Pattern, by_row, full, multiplied
from ewif_jax.kernels import cholesky, symmetric


class Innovation(NamedTuple):
    """What a measurement is compared with: value (m,), cov (m, m), its factor, and H P (m, n)."""

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
    return -0.5 * (jnp.sum(jnp.square(white)) + count * jnp.log(2 * jnp.pi)) - half_log_det


def gain(innovation: Innovation) -> Array:
    """K = P H' S^-1, (n, m)."""
    return cholesky.solve(innovation.factor, innovation.cross).T


def update(
    mean: Array,
    packed: Array,
    difference: Array,
    H: Array,
    R: Array,
    mask: Array,
    H_where: Pattern | None = None,
) -> tuple[Array, Array, Innovation]:
    """Mean and packed covariance after a linear(ised) measurement, with the innovation.

    `difference` (m,) is measured minus predicted, H (m, n), R (m, m), mask (m,); H may differ from
    zero `H_where`. The covariance is
    (I - K H) P (I - K H)' + K R K' in two low-rank steps. The second uses H applied to the rounded
    result of the first, which is what makes the Joseph form forget rounding errors of the gain.
    What P itself was rounded by it cannot forget: where that exceeds a variance that is left (a
    prior 1/eps times as wide as R), the variance is 0, never negative.
    """
    H, R = jnp.where(mask[:, None], H, 0), mask_cov(R, mask)
    cross = symmetric.rows(H, packed, H_where)
    cov = _expected(H_where)(cross, H, R)
    innovation = Innovation(jnp.where(mask, difference, 0), cov, cholesky.factor(cov), cross)
    weights = cholesky.solve(innovation.factor, cross)
    mean = _moved(mean, weights, innovation.value)
    half = _less(packed, cross, weights)
    left_over = _left_over(R, weights, symmetric.rows(H, half, H_where))
    return mean, _more(half, weights, left_over), innovation


@cache
def _expected(where: Pattern | None) -> Callable[[Array, Array, Array], Array]:
    @kernel
    def expected(cross: Array, H: Array, R: Array) -> Array:
        """H P H' + R, from H P."""
        if H.ndim == 2:
            return R + multiplied(cross, H.T)
        terms = by_row(H, where or full(*H.shape[:2]))
        return R + total(cross[:, column] * factor[None] for factor, column in terms)

    return expected


def update_from_afar(
    mean: Array,
    packed: Array,
    difference: Array,
    cross: Array,
    spread: Array,
    R: Array,
    mask: Array,
) -> tuple[Array, Array, Innovation]:
    """`update` by a measurement of something else: `cross` (m, n) is its covariance with the state,
    `spread` (m, m) its own without noise."""
    innovation = innovate(difference, cross, spread + R, mask)
    weights = cholesky.solve(innovation.factor, innovation.cross)
    mean = _moved(mean, weights, innovation.value)
    half = _less(packed, innovation.cross, weights)
    seen = innovation.cross - matmul(jnp.where(mask[:, None] & mask[None, :], spread, 0), weights)
    return mean, _more(half, weights, _left_over(mask_cov(R, mask), weights, seen)), innovation


@kernel
def _moved(mean: Array, weights: Array, value: Array) -> Array:
    """mean + K value, with K' = weights."""
    return mean + _contract(weights, value[:, None])


@kernel
def _less(packed: Array, cross: Array, weights: Array) -> Array:
    """P - P H' K', packed."""
    rows, cols = np.triu_indices(cross.shape[1])
    return packed - _contract(cross[:, rows], weights[:, cols])


@kernel
def _left_over(R: Array, weights: Array, seen: Array) -> Array:
    """R K' - H half; `seen` = H half."""
    return _contract(R[:, :, None], weights[:, None, :]) - seen


@kernel
def _more(half: Array, weights: Array, left_over: Array) -> Array:
    """half + K left_over, packed, no variance below 0."""
    rows, cols = np.triu_indices(weights.shape[1])
    cov = half + _contract(weights[:, rows], left_over[:, cols])
    return symmetric.no_negative(cov)


def _contract(a: Array, b: Array) -> Array:
    """The sum of a b over their first axis."""
    return total(a[k] * b[k] for k in range(a.shape[0]))
