"""What rounding leaves over when a mean moves."""

import jax.numpy as jnp
from jax import Array

from ewif_jax.fast.small import matvec
from ewif_jax.fast.sparse import Pattern


def moved(F: Array, c: Array | None, mean: Array, where: Pattern | None) -> tuple[Array, Array]:
    """F mean + c (n,), and what rounding left of it over (n,); F may differ from zero `where`.

    Over a short interval a mean far from the origin moves by less than it is rounded by: 3 m/s for
    0.01 s is half of what float32 resolves at 1e6 m, and a target there would stand still.
    """
    if where is not None:
        where = tuple((*row[:k], True, *row[k + 1 :]) for k, row in enumerate(where))
    change = matvec(F - jnp.eye(mean.shape[0], dtype=F.dtype), mean, where)
    change = change if c is None else change + c
    there = mean + change
    return there, change - (there - mean)
