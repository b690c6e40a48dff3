"""Triangular factors by modified Gram-Schmidt: square roots of sums of covariances."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from ewif_jax.kernels import cholesky
from ewif_jax.types import DTypeLike


def least_root(dtype: DTypeLike) -> float:
    """The root of a variance of zero, as it is held here: its square is still an ordinary number,
    and so is a derivative over that."""
    return 2.0 ** (-45 if jnp.finfo(dtype).bits == 32 else -400)


def is_some(root: Array) -> Array:
    """Whether a root is that of a variance that is not zero."""
    return root > 1024 * least_root(root.dtype)


def root_of(a: Array) -> Array:
    """Lower-triangular L (n, n) with L L' = a, which has a derivative where a is singular too.

    The root of q has none at q = 0, and with a root of 0 every slope would be lost:
    d(L L') = L dL' + dL L'. So a pivot that is zero to rounding is held as the square of
    `least_root`, and what a changes by, over that, is how L changes: L dL' is then what it should
    be.
    """
    n, least = a.shape[0], least_root(a.dtype)
    zero = cholesky.negligible(n, a.dtype) * jnp.diagonal(a)
    columns, rest = [], a
    for j in range(n):
        here = rest[:, j] * jnp.asarray(np.arange(n) >= j, a.dtype)
        kept = here[j] > zero[j]
        reciprocal = jnp.where(kept, lax.rsqrt(jnp.where(kept, here[j], 1)), 0)
        place = jnp.asarray(np.arange(n) == j, a.dtype)
        # A zero in value with a derivative: da / least, halved on the diagonal because L L' counts
        # that element twice. The product least times dL is then da, as it should be.
        changes = (here - lax.stop_gradient(here)) * (1 - place / 2) / least
        column = jnp.where(kept, here * reciprocal, place * least + changes)
        columns.append(column)
        rest = rest - jnp.where(kept, column[:, None] * column[None], 0)
    return jnp.stack(columns, 1)


def small_held(root: Array) -> Array:
    """The root, where columns of what counts as zero are as small as ever: motion would make
    something of them. What they change by is kept in the product with its transpose."""
    least, fixed = least_root(root.dtype), lax.stop_gradient(root)
    # The value is scaled down and the change scaled up by the same factor: L dL' is what counts,
    # and it is unchanged.
    size = jnp.max(jnp.abs(fixed), axis=0)
    scale = jnp.where((size > least) & ~is_some(size), least / jnp.maximum(size, least), 1)[None]
    return fixed * scale + (root - fixed) / scale


def triangularise(a: Array) -> Array:
    """Lower-triangular L (n, n) with L L' = a a' for any a (n, k).

    Modified Gram-Schmidt on the rows, which is as accurate here as Householder's reflections
    (Bjorck 1967) and, unlike their derivative, is defined when rows are zero or dependent: such a
    row gives a zero column.
    """
    n = a.shape[0]
    rows = [a[i] for i in range(n)]
    lower = [[jnp.zeros((), a.dtype)] * n for _ in range(n)]
    for i in range(n):
        # Each row is taken out of all later ones at once (modified): taken out of the original rows
        # (classical), rounding would leave them far from orthogonal (Bjorck 1967).
        unit, lower[i][i] = _normalised_row(rows[i])
        for j in range(i + 1, n):
            lower[j][i] = rows[j] @ unit
            rows[j] = rows[j] - lower[j][i] * unit
    return jnp.stack([jnp.stack(row) for row in lower])


@jax.custom_jvp
def _normalised_row(row: Array) -> tuple[Array, Array]:
    """A row over its length, and the length; zeros of zeros."""
    square = row @ row
    kept = square > 0
    reciprocal = jnp.where(kept, lax.rsqrt(jnp.where(kept, square, 1)), 0)
    return row * reciprocal, square * reciprocal


@_normalised_row.defjvp
def _normalised_jvp(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Any, Any]:
    """Written out, because the derivative of a reciprocal root overflows where `least_root` cubed
    underflows."""
    (unit, length), (change,) = _normalised_row(*primals), tangents
    # d|row| = unit . d row, and d unit is what of d row is across unit, over the length.
    longer = unit @ change
    kept = length > 0
    across = (change - longer * unit) / jnp.where(kept, length, 1)
    return (unit, length), (jnp.where(kept, across, 0), longer)
