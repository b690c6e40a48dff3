"""Symmetric matrices stored as their upper triangle, row by row: n (n + 1) / 2 numbers.

What is stored this way is symmetric by construction, and its propagation is one matrix product.
"""

from collections.abc import Callable
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from ewif_jax.kernels.batched import kernel, linear_kernel, stage, total


def order(packed: Array) -> int:
    """n of a packed symmetric matrix."""
    return (int(np.sqrt(8 * packed.shape[0] + 1)) - 1) // 2


@cache
def places(n: int) -> np.ndarray:
    """Where element (i, j) is stored, (n, n)."""
    rows, cols = np.triu_indices(n)
    where = np.zeros((n, n), int)
    where[rows, cols] = where[cols, rows] = np.arange(rows.size)
    return where


def _pick(full: Array) -> Array:
    n = full.shape[0]
    rows, cols = np.triu_indices(n)
    return full.reshape(n * n, *full.shape[2:])[rows * n + cols]


def _fill(packed: Array) -> Array:
    n = order(packed)
    upper = jnp.asarray(np.triu(np.ones((n, n))), packed.dtype)
    return _spread(packed) * upper.reshape(n, n, *(1,) * (packed.ndim - 1))


def _spread(packed: Array) -> Array:
    n = order(packed)
    return packed[places(n).ravel()].reshape(n, n, *packed.shape[1:])


def _gather(full: Array) -> Array:
    n = full.shape[0]
    rows, cols = np.triu_indices(n)
    flat = full.reshape(n * n, *full.shape[2:])
    twice = jnp.asarray(rows != cols, full.dtype).reshape(-1, *(1,) * (full.ndim - 2))
    return flat[rows * n + cols] + twice * flat[cols * n + rows]


_pack = linear_kernel(_pick, _fill, cheap=True)
_unpack = linear_kernel(_spread, _gather)


def pack(full: Array) -> Array:
    """The upper triangle (n (n + 1) / 2,) of a symmetric matrix (n, n)."""
    return _pack(full)


def unpack(packed: Array) -> Array:
    """The symmetric matrix (n, n) of its packed upper triangle."""
    return _unpack(packed)


def congruence(a: Array, packed: Array) -> Array:
    """a P a' for a square matrix a and a packed P, packed.

    With a shared by the batch this is one product with a's second power.
    """
    return _congruence(a, packed)


def rows(a: Array, packed: Array) -> Array:
    """a P (m, n) for a matrix a (m, n) and a packed P."""
    return _rows(a, packed)


def times(packed: Array, x: Array) -> Array:
    """P x (n,) for a packed P."""
    return _times(packed, x)


def diagonal(packed: Array) -> Array:
    """The diagonal (n,) of a packed matrix."""
    n = order(packed)
    return packed[np.diagonal(places(n))]


def inverse(packed: Array) -> tuple[Array, Array]:
    """P^-1, packed, and whether P has full rank; where it has not, the identity with derivative 0.

    A pivot that is zero to rounding (below 8 n eps times its diagonal element) ends the rank. The
    derivative is that of the exact inverse, -P^-1 dP P^-1.
    """
    result = _inverse(packed)
    full_rank = jnp.all(diagonal(result) > 0)
    identity = pack(jnp.eye(order(packed), dtype=packed.dtype))
    return jnp.where(full_rank, result, identity), full_rank


@jax.custom_jvp
def _inverse(packed: Array) -> Array:
    return _swept(packed)


@_inverse.defjvp
def _inverse_jvp(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    result = _inverse(*primals)
    return result, -congruence(unpack(result), *tangents)


@kernel
def _swept(packed: Array) -> Array:
    """Gauss-Jordan elimination without exchanges; zero rows where there is no pivot."""
    n, batch = order(packed), packed.ndim - 1
    least = 8 * n * float(jnp.finfo(packed.dtype).eps) * diagonal(packed)
    for k in range(n):
        packed = stage(_sweep(n, k), packed, least[k], batch=batch)
    return -packed


@cache
def _sweep(n: int, k: int) -> Callable[[Array, Array], Array]:
    rows, cols = np.triu_indices(n)

    def swept(packed: Array, least: Array) -> Array:
        """Exchanges the roles of unknown and right-hand side number k."""
        shape = (-1, *(1,) * (packed.ndim - 1))
        pivot = packed[places(n)[k, k]]
        kept = pivot > least
        reciprocal = jnp.where(kept, 1 / jnp.where(kept, pivot, 1), 0)
        left = jnp.where((rows == k).reshape(shape), -1, packed[places(n)[k, rows]])
        right = jnp.where((cols == k).reshape(shape), -1, packed[places(n)[k, cols]])
        others = jnp.where(((rows == k) | (cols == k)).reshape(shape), 0, packed)
        return others - reciprocal[None] * left * right

    return swept


@kernel
def _times(packed: Array, x: Array) -> Array:
    full = _spread(packed)
    return total(full[:, k] * x[None, k] for k in range(x.shape[0]))


@kernel
def _rows(a: Array, packed: Array) -> Array:
    if packed.ndim == 1:
        return _left(a, packed)
    n = a.shape[1]
    where = places(n)
    columns = [total(a[:, k] * packed[where[k, j]][None] for k in range(n)) for j in range(n)]
    return jnp.stack(columns, 1)


@kernel
def _congruence(a: Array, packed: Array) -> Array:
    n, batch = a.shape[0], packed.ndim - 1
    rows, cols = np.triu_indices(n)
    if batch == 0:
        half = _left(a, packed)
        return _pick(total(half[:, k, None] * a[None, :, k] for k in range(n)))
    if a.size > n * n:
        half = stage(_left, a, packed, batch=batch)
        return total(half[rows, k] * a[cols, k] for k in range(n))
    flat = a.reshape(n * n)

    def minor(i: np.ndarray, j: np.ndarray) -> Array:
        return flat[i[:, None] * n + j[None, :]]

    twice = np.asarray(rows != cols, a.dtype)[None, :]
    power = minor(rows, rows) * minor(cols, cols) + twice * minor(rows, cols) * minor(cols, rows)
    moved = lax.dot(power, packed.reshape(rows.size, -1), precision=lax.Precision.HIGHEST)
    return moved.reshape(packed.shape)


def _left(a: Array, packed: Array) -> Array:
    full = _spread(packed)
    return total(a[:, k, None] * full[None, k] for k in range(a.shape[1]))
