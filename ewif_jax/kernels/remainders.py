"""What rounding leaves over when a mean moves."""

import jax.numpy as jnp
from jax import Array

from ewif_jax.fast.small import matvec
from ewif_jax.fast.sparse import Matrix, apart, with_zeros


def moved_with_rest(F: Array | Matrix, c: Array | None, mean: Array) -> tuple[Array, Array]:
    """F mean + c (n,), and what rounding left of it over (n,).

    Over a short interval a mean far from the origin moves by less than it is rounded by: 3 m/s for
    0.01 s is half of what float32 resolves at 1e6 m, and a target there would stand still.
    """
    values, where = apart(F)
    if where is not None:
        where = tuple((*row[:k], True, *row[k + 1 :]) for k, row in enumerate(where))
    # F - I keeps the digits of a short interval: F mean would add a small change to a large mean
    # and round it away. The identity's places are added to the pattern, since F_kk - 1 may differ
    # from 0 where F_kk does.
    change = matvec(with_zeros(values - jnp.eye(mean.shape[0], dtype=F.dtype), where), mean)
    change = change if c is None else change + c
    there = mean + change
    # The two-sum of Kahan and Knuth: there - mean is exact where the change is smaller than the
    # mean, so this is what the addition has lost.
    return there, change - (there - mean)
