"""Factors and solves for small positive semidefinite matrices, unrolled and guarded.

A pivot that is zero to rounding is skipped (its row of the solution is zero), so nothing divides
by zero and gradients stay finite where a matrix is singular.
"""

from functools import cache
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from ewif_jax.kernels.batched import kernel, stage


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
    if tolerance is None:
        tolerance = negligible(a.shape[0], a.dtype)
    lower, reciprocal = _factor(tolerance)(a)
    return Factor(lower, reciprocal, jnp.all(reciprocal > 0))


def negligible(n: int, dtype: jnp.dtype) -> float:
    """Below this share of its diagonal element a pivot of an (n, n) matrix counts as zero."""
    return 8 * n * float(jnp.finfo(dtype).eps)


def forward(f: Factor, b: Array) -> Array:
    """lower^-1 b for b (n,) or (n, k)."""
    return _forward(f.lower, f.reciprocal, b)


def backward(f: Factor, b: Array) -> Array:
    """lower'^-1 b for b (n,) or (n, k)."""
    return _backward(f.lower, f.reciprocal, b)


def solve(f: Factor, b: Array) -> Array:
    """A^-1 b for b (n,) or (n, k)."""
    return _solve(f.lower, f.reciprocal, b)


def inverse(f: Factor) -> Array:
    """A^-1 (n, n), symmetric by construction."""
    root = forward(f, jnp.eye(f.lower.shape[0], dtype=f.lower.dtype))
    return root.T @ root


def half_log_det(f: Factor) -> Array:
    """log det A / 2 over the pivots that are not zero."""
    return -jnp.sum(jnp.log(jnp.where(f.reciprocal > 0, f.reciprocal, 1)))


@cache
def _factor(tolerance: float):
    @kernel
    def factored(a: Array) -> tuple[Array, Array]:
        n, batch = a.shape[0], a.ndim - 2
        columns, reciprocals = [], []
        rest = a
        for j in range(n):
            kept = rest[j, j] > tolerance * a[j, j]
            reciprocal = jnp.where(kept, lax.rsqrt(jnp.where(kept, rest[j, j], 1)), 0)
            below = np.arange(n).reshape(n, *(1,) * batch) >= j
            column = jnp.where(below, rest[:, j] * reciprocal[None], 0)
            columns.append(column)
            reciprocals.append(reciprocal)
            if j + 1 < n:
                rest = _then(_downdate, rest, column, column)
        return jnp.stack(columns, 1), jnp.stack(reciprocals)

    return factored


def _forward_rows(lower: Array, reciprocal: Array, b: Array) -> Array:
    x = []
    for j in range(b.shape[0]):
        x.append(_scaled(b, reciprocal, j))
        if j + 1 < b.shape[0]:
            b = _then(_downdate, b, lower[:, j], x[-1])
    return jnp.stack(x)


def _backward_rows(lower: Array, reciprocal: Array, b: Array) -> Array:
    x = []
    for j in reversed(range(b.shape[0])):
        x.append(_scaled(b, reciprocal, j))
        if j > 0:
            b = _then(_downdate, b, lower[j, :], x[-1])
    return jnp.stack(x[::-1])


def _solve_rows(lower: Array, reciprocal: Array, b: Array) -> Array:
    return _backward_rows(lower, reciprocal, _forward_rows(lower, reciprocal, b))


_forward, _backward, _solve = map(kernel, (_forward_rows, _backward_rows, _solve_rows))


def _scaled(b: Array, reciprocal: Array, j: int) -> Array:
    """b[j] times reciprocal[j]; b may have one axis more."""
    factor = reciprocal[j]
    return b[j] * (factor if b[j].ndim == factor.ndim else factor[None])


def _downdate(b: Array, column: Array, row: Array) -> Array:
    """b - column row', or b - column times the number `row`."""
    outer = column * row[None] if column.ndim == b.ndim else column[:, None] * row[None]
    return b - outer


def _then(fn, b: Array, column: Array, row: Array) -> Array:
    """The next step of an elimination, kept apart where recomputing earlier ones would add up."""
    if b.shape[0] <= 3:
        return fn(b, column, row)
    return stage(fn, b, column, row, batch=column.ndim - 1)
