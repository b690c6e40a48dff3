"""Factors and solves for small positive semidefinite matrices, unrolled and guarded.

A pivot that is zero to rounding is skipped (its row of the solution is zero), so nothing divides
by zero and gradients stay finite where a matrix is singular.
"""

from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import Array, lax

from ewif_jax.fast.batched import kernel, stacked, stage


class Factor(NamedTuple):
    """lower (n, n) with A = lower lower', the reciprocals of its diagonal (n,), and the rank."""

    lower: Array
    reciprocal: Array
    full_rank: Array


def factor(a: Array, tolerance: float | None = None, size: Array | None = None) -> Factor:
    """The guarded Cholesky factor of a symmetric (n, n) matrix.

    A pivot counts as zero when it is below `tolerance` times the diagonal element it came from
    (default 8 n eps), or times the `size` (n,) of the terms that element was summed from: then its
    column is zero and `full_rank` is False.
    """
    if tolerance is None:
        tolerance = negligible(a.shape[0], a.dtype)
    sizes = () if size is None else (size,)
    lower, reciprocal = _factor_kernel(tolerance)(a, *sizes)
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
    return _solved_kernel(negligible(a.shape[0], a.dtype))(a, b)


def inverse(f: Factor) -> Array:
    """A^-1 (n, n), symmetric by construction."""
    # L^-1 once, then its square: symmetric to the last bit, and half the work of two solves.
    root = forward(f, jnp.eye(f.lower.shape[0], dtype=f.lower.dtype))
    return root.T @ root


def half_log_det(f: Factor) -> Array:
    """log det A / 2 over the pivots that are not zero."""
    # From the reciprocals, which exist already: the pivots themselves would be divided out again.
    return -jnp.sum(jnp.log(jnp.where(f.reciprocal > 0, f.reciprocal, 1)))


@cache
def _factor_kernel(tolerance: float) -> Callable[..., tuple[Array, Array]]:
    return kernel(lambda a, *size: _factored_columns(a, tolerance, *size))


@cache
def _solved_kernel(tolerance: float) -> Callable[[Array, Array], Array]:
    return kernel(lambda a, b: _solve_rows(*_factored_columns(a, tolerance), b))


def _factored_columns(a: Array, tolerance: float, size: Array | None = None) -> tuple[Array, Array]:
    n, batch = a.shape[0], a.ndim - 2
    columns, reciprocals, rest = [], [], a
    for j in range(n):
        column, reciprocal = _step_apart(
            n, _column_step(tolerance), rest, a[j, j] if size is None else size[j], batch=batch
        )
        columns.append(lax.pad(column, jnp.zeros((), a.dtype), [(j, 0, 0), *[(0, 0, 0)] * batch]))
        reciprocals.append(reciprocal)
        if j < n - 1:
            below = column[1:]
            rest = _step_apart(
                n, _product_less, rest[1:, 1:], below[:, None], below[None], batch=batch
            )
    return jnp.stack(columns, 1), jnp.stack(reciprocals)


@cache
def _column_step(tolerance: float) -> Callable[..., tuple[Array, Array]]:
    """(what is left of a, the diagonal element as it was) -> the first column of the factor, and
    the reciprocal of its pivot."""

    def column(rest: Array, diagonal: Array) -> tuple[Array, Array]:
        pivot = rest[0, 0]
        # The pivot is compared with the terms it is the difference of: what is left of a diagonal
        # element by cancellation is rounding below a few n eps of it (Higham, Accuracy and
        # Stability, ch. 10). The inner `where` keeps the root of a skipped pivot out of the
        # derivative: inf times 0 is NaN.
        kept = pivot > tolerance * diagonal
        reciprocal = jnp.where(kept, lax.rsqrt(jnp.where(kept, pivot, 1)), 0)
        return rest[:, 0] * reciprocal[None], reciprocal

    return column


def _forward_rows(lower: Array, reciprocal: Array, b: Array) -> Array:
    n, x = len(b), []
    for j in range(n):
        x.append(_scaled_by(b[0], reciprocal[j]))
        if j < n - 1:
            factors = lower[j + 1 :, j]
            b = _step_apart(
                n, _product_less, b[1:], _wide_as(factors, b), x[-1][None], batch=lower.ndim - 2
            )
    return stacked(x)


def _backward_rows(lower: Array, reciprocal: Array, b: Array) -> Array:
    n, x = len(b), []
    for j in reversed(range(n)):
        x.insert(0, _scaled_by(b[-1], reciprocal[j]))
        if j > 0:
            b = _step_apart(
                n,
                _product_less,
                b[:-1],
                _wide_as(lower[j, :j], b),
                x[0][None],
                batch=lower.ndim - 2,
            )
    return stacked(x)


def _solve_rows(lower: Array, reciprocal: Array, b: Array) -> Array:
    return _backward_rows(lower, reciprocal, _forward_rows(lower, reciprocal, b))


_forward, _backward, _solve = map(kernel, (_forward_rows, _backward_rows, _solve_rows))


def _step_apart(n: int, fn: Callable[..., Any], *args: Array, batch: int) -> Any:
    """`fn`, computed once where recomputing for an (n, n) matrix would add up."""
    # Unrolled and fused, a step would be computed again for each later one that reads it. Up to 3
    # rows that costs less than the calls.
    return stage(fn, *args, batch=batch) if n > 3 else fn(*args)


def _product_less(x: Array, a: Array, b: Array) -> Array:
    return x - a * b


def _scaled_by(x: Array, number: Array) -> Array:
    return x * (number if x.ndim == number.ndim else number[None])


def _wide_as(x: Array, like: Array) -> Array:
    """`x` with the axis that right-hand sides have, if there is one in `like`."""
    return x[:, None] if like.ndim > x.ndim else x
