"""Small matrices whose zeros are known before anything runs: what is zero is not multiplied."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ewif_jax.fast.batched import total

Pattern = tuple[tuple[bool, ...], ...]
"""Row by row, where a matrix may differ from zero."""


def pattern(*matrices: np.ndarray) -> Pattern:
    """Where any of these (rows, columns) is not zero."""
    anywhere = np.any([np.asarray(m) != 0 for m in matrices], 0)
    return tuple(tuple(bool(x) for x in row) for row in anywhere)


@jax.tree_util.register_dataclass
@dataclass(frozen=True, eq=False)
class Matrix:
    """A small matrix that carries where it may differ from zero: products of `fast.small` and
    `kernels.symmetric` with it from the left leave the rest out. Everywhere else it is its
    `values`."""

    values: Array
    where: Pattern = field(metadata={"static": True})

    @property
    def shape(self) -> tuple[int, ...]:
        """(rows, columns)."""
        return self.values.shape

    @property
    def dtype(self) -> Any:
        """That of the values."""
        return self.values.dtype

    @property
    def T(self) -> "Matrix":
        """The transpose."""
        return Matrix(self.values.T, transposed(self.where))

    def __matmul__(self, other: Any) -> Array:
        return self.values @ jnp.asarray(other)

    def __jax_array__(self) -> Array:
        return self.values

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        return np.array(self.values, dtype)


def with_zeros(values: Array, where: Pattern | None) -> Array | Matrix:
    """The matrix with the zeros that are known, if any are."""
    return values if where is None else Matrix(values, where)


def apart(a: Array | Matrix) -> tuple[Array, Pattern | None]:
    """Values, and where they may differ from zero, if that is known."""
    return (a.values, a.where) if isinstance(a, Matrix) else (a, None)


def dense(a: Array | Matrix) -> Array:
    """The values alone."""
    return apart(a)[0]


def elementwise(fn: Callable[[Array], Array], a: Array | Matrix) -> Any:
    """`fn` of the values, for a function that leaves zeros where they are."""
    return replace(a, values=fn(a.values)) if isinstance(a, Matrix) else fn(a)


def transposed(where: Pattern) -> Pattern:
    """The pattern of the transpose."""
    return tuple(zip(*where, strict=True))


class Terms(NamedTuple):
    """Row by row the columns of a sparse matrix, (T, rows); a row with fewer than T elements goes
    on with its first column, and `counts` False."""

    columns: np.ndarray
    counts: np.ndarray


@cache
def terms(where: Pattern) -> Terms:
    """What each row multiplies."""
    flags = np.asarray(where, bool)
    count = flags.sum(1)
    t = np.arange(max(int(count.max(initial=0)), 1))[:, None]
    order = np.argsort(~flags, axis=1, kind="stable")
    counts = t < count
    # int32, which stays what it is when x64 is switched: JAX keeps what it made of an index array.
    return Terms(np.where(counts, order.T[: len(t)], order[:, 0]).astype(np.int32), counts)


def full(rows: int, cols: int) -> Pattern:
    """The pattern of a matrix of which nothing is known."""
    return ((True,) * cols,) * rows


def elements(a: Array, rows: np.ndarray, cols: np.ndarray, counts: np.ndarray) -> Array:
    """a[rows, cols] of a matrix (n, k, ...) where it `counts`, else 0."""
    # Flat indices, known before tracing: one gather along the leading axis, batch behind.
    picked = a.reshape(a.shape[0] * a.shape[1], *a.shape[2:])[rows * a.shape[1] + cols]
    if counts.all():
        return picked
    # Fillers are multiplied by 0, so that all rows have equally many terms and the sum has one
    # shape; they point at an element of the same row, never out of the matrix.
    return picked * jnp.asarray(counts, a.dtype).reshape(counts.shape + (1,) * (a.ndim - 2))


def by_row(a: Array, where: Pattern) -> list[tuple[Array, np.ndarray]]:
    """The terms of a product with a matrix a (rows, k, ...): what each row multiplies (rows, ...),
    and which column (rows,)."""
    columns, counts = terms(where)
    factors = elements(a, np.arange(a.shape[0])[:, None], columns.T, counts.T)
    return [(factors[:, t], column) for t, column in enumerate(columns)]


def product(a: Array, x: Array, where: Pattern) -> Array:
    """a x for a matrix a (rows, k, ...) and a vector x (k, ...) or matrix x (k, n, ...)."""
    if a.ndim == 2:
        return multiplied(a, x)
    between = (slice(None), *(None,) * (x.ndim - a.ndim + 1))
    return total(factor[between] * _picked_rows(x, column) for factor, column in by_row(a, where))


def _picked_rows(x: Array, which: np.ndarray) -> Array:
    """x[which], which is x itself where that is all rows in their order."""
    return x if np.array_equal(which, np.arange(x.shape[0])) else x[which]


def multiplied(a: Array, x: Array) -> Array:
    """a x for a single small matrix and a vector or matrix, as one loop: a library takes longer to
    call, and a sum of terms longer to compile."""
    return jnp.sum(a * x[None] if x.ndim == 1 else a[:, :, None] * x[None], 1)
