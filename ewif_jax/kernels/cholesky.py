"""Factors and solves for small positive semidefinite matrices, unrolled and guarded.

A pivot that is zero to rounding is skipped (its row of the solution is zero), so nothing divides
by zero and gradients stay finite where a matrix is singular.
"""

from collections.abc import Callable, Sequence
from functools import cache
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from ewif_jax.kernels.batched import kernel, stage


class Factor(NamedTuple):
    """lower (n, n) with A = lower lower', the reciprocals of its diagonal (n,), and the rank."""

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


def solved(a: Array, b: Array) -> Array:
    """A^-1 b for b (n,) or (n, k), where the factor itself is not needed."""
    return _solved(negligible(a.shape[0], a.dtype))(a, b)


def inverse(f: Factor) -> Array:
    """A^-1 (n, n), symmetric by construction."""
    root = forward(f, jnp.eye(f.lower.shape[0], dtype=f.lower.dtype))
    return root.T @ root


def half_log_det(f: Factor) -> Array:
    """log det A / 2 over the pivots that are not zero."""
    return -jnp.sum(jnp.log(jnp.where(f.reciprocal > 0, f.reciprocal, 1)))


@cache
def _factor(tolerance: float) -> Callable[[Array], tuple[Array, Array]]:
    return kernel(lambda a: _factored(a, tolerance))


@cache
def _solved(tolerance: float) -> Callable[[Array, Array], Array]:
    return kernel(lambda a, b: _solve_rows(*_factored(a, tolerance), b))


def _factored(a: Array, tolerance: float) -> tuple[Array, Array]:
    columns, reciprocals = [], []
    for j in range(a.shape[0]):
        column, reciprocal = _apart(_column(j, tolerance), a, *columns, batch=a.ndim - 2)
        columns.append(column)
        reciprocals.append(reciprocal)
    return jnp.stack(columns, 1), jnp.stack(reciprocals)


@cache
def _column(j: int, tolerance: float) -> Callable[..., tuple[Array, Array]]:
    """(a, columns before j) -> column j of the factor, and the reciprocal of its pivot."""

    def column(a: Array, *columns: Array) -> tuple[Array, Array]:
        rest = _less(a[:, j], [c[j] for c in columns], columns)
        kept = rest[j] > tolerance * a[j, j]
        reciprocal = jnp.where(kept, lax.rsqrt(jnp.where(kept, rest[j], 1)), 0)
        below = np.arange(a.shape[0]).reshape(-1, *(1,) * (a.ndim - 2)) >= j
        return jnp.where(below, rest * reciprocal[None], 0), reciprocal

    return column


def _forward_rows(lower: Array, reciprocal: Array, b: Array) -> Array:
    x: list[Array] = []
    for j in range(b.shape[0]):
        x.append(_apart(_row(j, True), lower, reciprocal, b, *x, batch=lower.ndim - 2))
    return jnp.stack(x)


def _backward_rows(lower: Array, reciprocal: Array, b: Array) -> Array:
    x: list[Array] = []
    for j in reversed(range(b.shape[0])):
        x.insert(0, _apart(_row(j, False), lower, reciprocal, b, *x, batch=lower.ndim - 2))
    return jnp.stack(x)


def _solve_rows(lower: Array, reciprocal: Array, b: Array) -> Array:
    return _backward_rows(lower, reciprocal, _forward_rows(lower, reciprocal, b))


_forward, _backward, _solve = map(kernel, (_forward_rows, _backward_rows, _solve_rows))


@cache
def _row(j: int, down: bool) -> Callable[..., Array]:
    """(lower, reciprocals, b, rows solved before) -> row j of the solution."""

    def row(lower: Array, reciprocal: Array, b: Array, *x: Array) -> Array:
        return _times(_less(b[j], lower[j, :j] if down else lower[j + 1 :, j], x), reciprocal[j])

    return row


def _apart(fn: Callable[..., Any], *args: Array, batch: int) -> Any:
    """`fn` of arrays, the first of them (n, n), computed once where recomputing would add up."""
    return stage(fn, *args, batch=batch) if args[0].shape[0] > 3 else fn(*args)


def _less(b: Array, numbers: Any, arrays: Sequence[Array]) -> Array:
    """b minus the sum of numbers times arrays."""
    for number, array in zip(numbers, arrays, strict=True):
        b = b - _times(array, number)
    return b


def _times(x: Array, number: Array) -> Array:
    """x times a number; x may have one axis more."""
    return x * (number if x.ndim == number.ndim else number[None])
