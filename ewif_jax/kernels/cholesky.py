"""Factors and solves for small positive semidefinite matrices, unrolled and guarded.

A pivot that is zero to rounding is skipped (its row of the solution is zero), so nothing divides
by zero and gradients stay finite where a matrix is singular.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array, lax

from ewif_jax.kernels.small import fence


class Factor(NamedTuple):
    """lower (n, n) with A = lower lower', the reciprocals of its diagonal (n,), full rank or not."""

    lower: Array
    reciprocal: Array
    full_rank: Array


def factor(a: Array, tolerance: float | None = None) -> Factor:
    """The guarded Cholesky factor of a symmetric (n, n) matrix.

    A pivot counts as zero when it is below `tolerance` times the diagonal element it came from
    (default 8 n eps): then its column is zero and `full_rank` is False.
    """
    n = a.shape[0]
    if tolerance is None:
        tolerance = 8 * n * float(jnp.finfo(a.dtype).eps)
    columns, reciprocals, full_rank = [], [], jnp.asarray(True)
    rest = a
    for j in range(n):
        kept = rest[j, j] > tolerance * a[j, j]
        reciprocal = jnp.where(kept, lax.rsqrt(jnp.where(kept, rest[j, j], 1)), 0)
        column = jnp.where(jnp.arange(n) < j, 0, rest[:, j] * reciprocal)
        columns.append(column)
        reciprocals.append(reciprocal)
        full_rank = full_rank & kept
        if j + 1 < n:
            rest = fence(rest - column[:, None] * column[None, :])
    return Factor(jnp.stack(columns, 1), jnp.stack(reciprocals), full_rank)


def forward(f: Factor, b: Array) -> Array:
    """lower^-1 b for b (n,) or (n, k)."""
    x = []
    for j in range(b.shape[0]):
        xj = b[j] * f.reciprocal[j]
        x.append(xj)
        b = b - jnp.multiply.outer(f.lower[:, j], xj)
    return jnp.stack(x)


def backward(f: Factor, b: Array) -> Array:
    """lower'^-1 b for b (n,) or (n, k)."""
    x = []
    for j in reversed(range(b.shape[0])):
        xj = b[j] * f.reciprocal[j]
        x.append(xj)
        b = b - jnp.multiply.outer(f.lower[j, :], xj)
    return jnp.stack(x[::-1])


def solve(f: Factor, b: Array) -> Array:
    """A^-1 b for b (n,) or (n, k)."""
    return backward(f, forward(f, b))


def inverse(f: Factor) -> Array:
    """A^-1 (n, n), symmetric by construction."""
    root = forward(f, jnp.eye(f.lower.shape[0], dtype=f.lower.dtype))
    return root.T @ root


def half_log_det(f: Factor) -> Array:
    """log det A / 2 over the pivots that are not zero."""
    return -jnp.sum(jnp.log(jnp.where(f.reciprocal > 0, f.reciprocal, 1)))
