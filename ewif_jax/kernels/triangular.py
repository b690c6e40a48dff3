"""Triangular factors by modified Gram-Schmidt: square roots of sums of covariances."""

import jax.numpy as jnp
from jax import Array, lax


def triangularise(a: Array, least: Array | None = None) -> Array:
    """Lower-triangular L (n, n) with L L' = a a' for any a (n, k).

    A row of which, after the ones before it, no more than `least` (n,) is left gives a zero column.

    Modified Gram-Schmidt on the rows, which is as accurate here as Householder's reflections
    (Bjorck 1967) and, unlike their derivative, is defined when rows are zero or dependent.
    """
    n = a.shape[0]
    rows = [a[i] for i in range(n)]
    lower = [[jnp.zeros((), a.dtype)] * n for _ in range(n)]
    for i in range(n):
        square = rows[i] @ rows[i]
        kept = square > (0 if least is None else jnp.square(least[i]))
        reciprocal = jnp.where(kept, lax.rsqrt(jnp.where(kept, square, 1)), 0)
        unit = rows[i] * reciprocal
        lower[i][i] = square * reciprocal
        for j in range(i + 1, n):
            lower[j][i] = rows[j] @ unit
            rows[j] = rows[j] - lower[j][i] * unit
    return jnp.stack([jnp.stack(row) for row in lower])
