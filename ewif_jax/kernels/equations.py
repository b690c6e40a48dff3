"""What is known of a state, as n equations that can be added to one by one.

Equation k says x_k + rows_k . (x_k+1, ..., x_n) = targets_k, with an error of variance variances_k
that is independent of the others; an infinite variance says nothing yet. An information matrix
squares the ratio of what is known best to what is known least, and rounding hides the least; here
the ratio stays as it is, and nothing is inverted to add to it. Gentleman (1973, J. Inst. Maths
Applics 12, 329) adds an equation in this way; Thornton (1976) moves the variances with weighted
Gram-Schmidt. The rows are kept one after the other without zeros and ones: n (n - 1) / 2 numbers.
"""

from collections.abc import Callable
from functools import cache
from itertools import pairwise
from typing import TypeGuard

import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from ewif_jax.fast.batched import kernel, stacked, stage, total
from ewif_jax.fast.sparse import Matrix, Pattern, apart, by_row
from ewif_jax.kernels import cholesky
from ewif_jax.types import DTypeLike


def solved(rows: Array, targets: Array) -> Array:
    """The solution (n,) of the equations."""
    return _solved(rows, targets)


def times(rows: Array, x: Array) -> Array:
    """What the left-hand sides (n,) are at x (n,)."""
    return _times(rows, x)


def leading(rows: Array, equations: Array) -> Array:
    """The equations (m, n) in terms of the errors of the rows: equations rows^-1."""
    return _leading(rows, equations)


def inverse(rows: Array) -> Array:
    """The inverse (n, n) of the unit upper triangular matrix, one too."""
    return _inverse(rows)


def covariance(inverse_rows: Array, variances: Array) -> Array:
    """The upper triangle of B diag(variances) B', row by row: its variances are sums of squares."""
    return _covariance(inverse_rows, variances)


def of_covariance(cov: Array) -> tuple[Array, Array]:
    """Variances and rows of a covariance (n, n), with the floor of `orthogonal.spread`."""
    return _of_covariance(cov)


def carried(rows: Array, back: Matrix) -> tuple[Array, Array]:
    """Rows after x <- back x' for an upper triangular matrix `back`, and its diagonal (n,), by
    which the targets have to be divided."""
    return _carried(back.where)(rows, back.values)


def is_upper(matrix: Array | Matrix) -> TypeGuard[Matrix]:
    """Whether a matrix is known to be upper triangular."""
    where = apart(matrix)[1]
    return where is not None and not np.tril(np.asarray(where, bool), -1).any()


def least_share(n: int, dtype: DTypeLike) -> float:
    """The square of the rounding of a component: no variance is a smaller share of it."""
    return (8 * n * float(jnp.finfo(dtype).eps)) ** 2


def _order(rows: Array) -> int:
    return (1 + int(np.sqrt(8 * rows.shape[0] + 1))) // 2


@kernel
def upper(rows: Array) -> Array:
    """The equations as a unit upper triangular matrix (n, n)."""
    n = _order(rows)
    index = np.full((n, n), rows.shape[0])
    index[np.triu_indices(n, 1)] = np.arange(rows.shape[0])
    np.fill_diagonal(index, rows.shape[0] + 1)
    ends = jnp.stack([jnp.zeros(rows.shape[1:], rows.dtype), jnp.ones(rows.shape[1:], rows.dtype)])
    return jnp.concatenate([rows, ends])[index]


@kernel
def strict(full: Array) -> Array:
    """What lies above the diagonal of a matrix (n, n), row by row."""
    n = full.shape[0]
    i, j = np.triu_indices(n, 1)
    return full.reshape(n * n, *full.shape[2:])[i * n + j]


def by_equation(rows: Array, n: int) -> list[Array]:
    """The coefficients of each of the n equations."""
    ends = np.cumsum([0, *range(n - 1, -1, -1)])
    return [rows[a:b] for a, b in pairwise(ends)]


@kernel
def _solved(rows: Array, targets: Array) -> Array:
    n, found = targets.shape[0], []
    for k, row in reversed(list(enumerate(by_equation(rows, n)))):
        terms = [targets[k], *(-row[j] * x for j, x in enumerate(found))]
        found.insert(0, total(terms))
    return stacked(found)


@kernel
def _times(rows: Array, x: Array) -> Array:
    n = x.shape[0]
    pieces = enumerate(by_equation(rows, n))
    return stacked(
        [total([x[k], *(row[j] * x[k + 1 + j] for j in range(n - 1 - k))]) for k, row in pieces]
    )


@kernel
def _leading(rows: Array, equations: Array) -> Array:
    n, batch, found = equations.shape[1], equations.ndim - 2, []
    for k, row in enumerate(by_equation(rows, n)):
        lead = equations[:, 0]
        found.append(lead)
        if k < n - 1:
            equations = stage(_eliminated, equations[:, 1:], lead, row, batch=batch)
    runs = jnp.broadcast_shapes(*(x.shape[1:] for x in found))
    return jnp.stack([jnp.broadcast_to(x, (len(x), *runs)) for x in found], 1)


def _eliminated(rest: Array, lead: Array, row: Array) -> Array:
    return rest - lead[:, None] * row[None]


@kernel
def _inverse(rows: Array) -> Array:
    n, batch = _order(rows), rows.ndim - 1
    ones, below = jnp.ones((1, *rows.shape[1:]), rows.dtype), []
    for k, row in reversed(list(enumerate(by_equation(rows, n)))):
        tail = [stage(_less, row, *below, batch=batch)] if k < n - 1 else []
        below.insert(0, jnp.concatenate([jnp.zeros((k, *rows.shape[1:]), rows.dtype), ones, *tail]))
    return jnp.stack(below)


def _less(row: Array, *below: Array) -> Array:
    first = below[0].shape[0] - len(below)
    return -total(r[None] * b[first:] for r, b in zip(row, below, strict=True))


@kernel
def _of_covariance(cov: Array) -> tuple[Array, Array]:
    # Rows of P and of the identity together: what makes P lower triangular, from its last row up,
    # makes the identity T with T P T' = diag(variances). A loop, since it happens once.
    n, runs = cov.shape[0], [1] * (cov.ndim - 2)
    eye = jnp.broadcast_to(jnp.eye(n, dtype=cov.dtype).reshape(n, n, *runs), cov.shape)
    diagonal = jnp.stack([cov[k, k] for k in range(n)])

    def eliminate(both: Array, k: Array) -> tuple[Array, Array]:
        column = lax.dynamic_index_in_dim(both, k, 1, keepdims=False)
        pivot, was = (lax.dynamic_index_in_dim(x, k, keepdims=False) for x in (column, diagonal))
        kept = pivot > cholesky.negligible(n, cov.dtype) * was
        above = (jnp.arange(n) < k).reshape(n, *runs)
        shares = jnp.where(above & kept[None], column / jnp.where(kept, pivot, 1)[None], 0)
        row = lax.dynamic_index_in_dim(both, k)
        return both - shares[:, None] * row, jnp.where(kept, pivot, 0)

    both, pivots = lax.scan(eliminate, jnp.concatenate([cov, eye], 1), jnp.arange(n), reverse=True)
    i, j = np.triu_indices(n, 1)
    return jnp.maximum(pivots, least_share(n, cov.dtype) * diagonal), both[i, n + j]


@kernel
def _covariance(inverse_rows: Array, variances: Array) -> Array:
    n = variances.shape[0]
    scaled = inverse_rows * variances[None]
    i, j = np.triu_indices(n)
    return total(scaled[i, k] * inverse_rows[j, k] for k in range(n))


@cache
def _carried(where: Pattern) -> Callable[[Array, Array], tuple[Array, Array]]:
    @kernel
    def moved(rows: Array, back: Array) -> tuple[Array, Array]:
        n = back.shape[0]
        i, j = np.triu_indices(n, 1)
        diagonal = jnp.stack([back[k, k] for k in range(n)])
        if back.ndim == 2:
            full = upper(rows) @ back if n > 8 else jnp.sum(upper(rows)[:, :, None] * back[None], 1)
            return full[i, j] / diagonal[i], diagonal
        matrix = stage(_as_matrix, rows, batch=rows.ndim - 1)
        across = tuple(zip(*where, strict=True))
        terms = by_row(jnp.swapaxes(back, 0, 1), across)
        summed = total(matrix[i, k[j]] * f[j] for f, k in terms)
        return summed / diagonal[i], diagonal

    return moved


def _as_matrix(rows: Array) -> Array:
    return upper(rows)
