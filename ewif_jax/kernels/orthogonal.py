"""A sum of independent errors as equations: Gram-Schmidt weighted by their variances."""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
from jax import Array

from ewif_jax.fast.batched import kernel, stacked, stage
from ewif_jax.kernels.equations import inverse, least_share, strict


def spread(vectors: Array, variances: Array, certain: bool = False) -> tuple[Array, Array]:
    """Variances and rows of sum_q variances_q vectors_q vectors_q', for vectors (n, q).

    No variance is below the rounding of its component, (8 n eps)^2 of it: what the motion makes as
    good as certain stays regular; or, with `certain`, becomes so.
    """
    unit, kept = (_spread_certain if certain else _spread_kernel)(vectors, variances)
    return kept, strict(inverse(strict(unit)))


@kernel
def _spread_kernel(vectors: Array, variances: Array) -> tuple[Array, Array]:
    return _orthogonal_vectors(vectors, variances, _projected_out)


@kernel
def _spread_certain(vectors: Array, variances: Array) -> tuple[Array, Array]:
    return _orthogonal_vectors(vectors, variances, _projected_certain)


def _orthogonal_vectors(vectors: Array, variances: Array, project: Callable[..., Any]) -> Any:
    n, batch = vectors.shape[0], variances.ndim - 1
    floors = least_share(n, vectors.dtype) * jnp.sum(vectors * vectors * variances[None], 1)
    # From the last component to the first, because the equations are unit upper triangular: row k
    # holds only components after it. Thornton (1976), weighted by the variances.
    rest, columns, kept = vectors, [], []
    for j in reversed(range(n)):
        rest, column, variance = stage(project, rest, variances, floors[j], batch=batch)
        zeros = jnp.zeros((n - 1 - j, *column.shape[1:]), column.dtype)
        columns.insert(0, jnp.concatenate([column, zeros]))
        kept.insert(0, variance)
    return jnp.stack(columns, 1), stacked(kept)


def _projected_out(rest: Array, variances: Array, floor: Array) -> tuple[Array, Array, Array]:
    """Takes the last vector out of the others."""
    weighted = rest[-1] * variances
    return _without_last(rest, weighted, jnp.maximum(jnp.sum(rest[-1] * weighted, 0), floor))


def _projected_certain(rest: Array, variances: Array, floor: Array) -> tuple[Array, Array, Array]:
    weighted = rest[-1] * variances
    variance = jnp.sum(rest[-1] * weighted, 0)
    return _without_last(rest, weighted, jnp.where(variance > floor, variance, 0))


def _without_last(rest: Array, weighted: Array, variance: Array) -> tuple[Array, Array, Array]:
    some = variance > 0
    reciprocal = jnp.where(some, 1 / jnp.where(some, variance, 1), 0)
    # The part of each other vector along the last one, in the inner product weighted by variances:
    # what is left over has errors independent of that component's.
    column = jnp.sum(rest[:-1] * weighted[None], 1) * reciprocal[None]
    one = jnp.ones((1, *column.shape[1:]), column.dtype)
    return rest[:-1] - column[:, None] * rest[-1][None], jnp.concatenate([column, one]), variance
