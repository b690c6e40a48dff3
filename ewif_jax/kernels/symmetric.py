"""Symmetric matrices stored as their upper triangle, row by row: n (n + 1) / 2 numbers.

What is stored this way is symmetric by construction, and its propagation is one matrix product.
"""

from collections.abc import Callable
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from ewif_jax.fast.batched import kernel, linear_kernel, smallest, stage, total
from ewif_jax.fast.small import matvec
from ewif_jax.fast.sparse import Matrix, Pattern, apart, by_row, full, multiplied


def order(packed: Array) -> int:
    """n of a packed symmetric matrix."""
    return (int(np.sqrt(8 * packed.shape[0] + 1)) - 1) // 2


@cache
def places(n: int) -> np.ndarray:
    """Where element (i, j) is stored, (n, n)."""
    rows, cols = np.triu_indices(n)
    # int32, which stays what it is when x64 is switched: JAX keeps what it made of an index array.
    where = np.zeros((n, n), np.int32)
    where[rows, cols] = where[cols, rows] = np.arange(rows.size)
    return where


def _pick_upper(full: Array) -> Array:
    n = full.shape[0]
    rows, cols = np.triu_indices(n)
    return full.reshape(n * n, *full.shape[2:])[rows * n + cols]


def _fill_upper(packed: Array) -> Array:
    n = order(packed)
    upper = jnp.asarray(np.triu(np.ones((n, n))), packed.dtype)
    return _spread_full(packed) * upper.reshape(n, n, *(1,) * (packed.ndim - 1))


def _spread_full(packed: Array) -> Array:
    n = order(packed)
    return packed[places(n).ravel()].reshape(n, n, *packed.shape[1:])


def _gather_upper(full: Array) -> Array:
    n = full.shape[0]
    rows, cols = np.triu_indices(n)
    flat = full.reshape(n * n, *full.shape[2:])
    # The adjoint of filling both triangles: an element off the diagonal is written to two places,
    # so its slope is the sum of both.
    twice = jnp.asarray(rows != cols, full.dtype).reshape(-1, *(1,) * (full.ndim - 2))
    return flat[rows * n + cols] + twice * flat[cols * n + rows]


_pack = linear_kernel(_pick_upper, _fill_upper, cheap=True)
_unpack = linear_kernel(_spread_full, _gather_upper)


def pack(full: Array) -> Array:
    """The upper triangle (n (n + 1) / 2,) of a symmetric matrix (n, n)."""
    return _pack(full)


def unpack(packed: Array) -> Array:
    """The symmetric matrix (n, n) of its packed upper triangle."""
    return _unpack(packed)


def congruence(a: Array | Matrix, packed: Array) -> Array:
    """a P a' for a square matrix a and a packed P, packed.

    A dense matrix a that the batch shares is one product with its second power.
    """
    values, where = apart(a)
    return _congruence_kernel(where)(values, packed)


def no_negative(packed: Array) -> Array:
    """P, where a variance that rounding has made negative is 0."""
    return _no_negative(packed)


def rows(a: Array | Matrix, packed: Array) -> Array:
    """a P (m, n) for a matrix a (m, n) and a packed P."""
    values, where = apart(a)
    return _rows_kernel(where)(values, packed)


def times(packed: Array, x: Array) -> Array:
    """P x (n,) for a packed P."""
    return matvec(unpack(packed), x)


def diagonal(packed: Array) -> Array:
    """The diagonal (n,) of a packed matrix."""
    n = order(packed)
    return packed[np.diagonal(places(n))]


def regress(packed: Array, cross: Array) -> tuple[Array, Array]:
    """B P^-1 (m, n) and B P^-1 B' (m, m) for a packed P and B (m, n): the weights of the regression
    on what has covariance P, and what they explain.

    A pivot that is zero to rounding (below 8 n eps times its diagonal element) is left out, with
    derivative 0.
    """
    return _regress_kernel(packed, cross)


def inverse(packed: Array) -> tuple[Array, Array]:
    """P^-1, packed, and whether P has full rank; where it has not, the identity with derivative 0.

    A pivot that is zero to rounding (below 8 n eps times its diagonal element) ends the rank. The
    derivative is that of the exact inverse, -P^-1 dP P^-1.
    """
    result = _inverse_swept(packed)
    # A pivot that was left out leaves a zero on the diagonal of the result. The outer `where` then
    # gives the identity and cuts the derivative off.
    full_rank = smallest(diagonal(result)) > 0
    identity = pack(jnp.eye(order(packed), dtype=packed.dtype))
    return jnp.where(full_rank, result, identity), full_rank


@kernel
def _regress_kernel(packed: Array, cross: Array) -> tuple[Array, Array]:
    """Elimination row by row of [[P, B'], [B, 0]], and back for the rows of the weights."""
    (m, n), batch = cross.shape[:2], packed.ndim - 1
    least = _least_pivot(packed)
    # Block elimination of P leaves 0 - B P^-1 B' in the corner: what is explained falls out with
    # its sign changed, symmetric, and without forming P^-1. The weights B P^-1 follow by going back
    # through the eliminated rows, as in solving (docs/decisions/estimators.md: "One elimination for
    # late measurements").
    rest, eliminated = stage(_bordered_matrix, packed, cross, batch=batch), []
    for k in range(n):
        reciprocal = stage(_pivot_reciprocal, rest[0], least[k], batch=batch)
        eliminated.append((rest[: n - k + m], reciprocal))
        rest = stage(_eliminated_first, rest, reciprocal, batch=batch)
    weights: list[Array] = []
    for row, reciprocal in reversed(eliminated):
        weights.insert(0, stage(_row_weights, row, reciprocal, *weights, batch=batch))
    return jnp.stack(weights, 1), -rest[places(m)]


def _bordered_matrix(packed: Array, cross: Array) -> Array:
    """[[P, B'], [B, 0]], packed."""
    m, n = cross.shape[:2]
    runs = jnp.broadcast_shapes(packed.shape[1:], cross.shape[2:])
    parts = packed, cross.reshape(m * n, *cross.shape[2:]), jnp.zeros_like(packed[:1])
    numbers = jnp.concatenate([jnp.broadcast_to(x, (len(x), *runs)) for x in parts])
    index = np.full((n + m, n + m), len(numbers) - 1)
    index[:n, :n] = places(n)
    index[:n, n:] = len(packed) + np.arange(m * n).reshape(m, n).T
    return numbers[index[np.triu_indices(n + m)]]


def _pivot_reciprocal(pivot: Array, least: Array) -> Array:
    """1 / pivot, or 0 where there is none."""
    kept = pivot > least
    return jnp.where(kept, 1 / jnp.where(kept, pivot, 1), 0)


def _eliminated_first(rest: Array, reciprocal: Array) -> Array:
    """The packed matrix without its first unknown."""
    n = order(rest)
    rows, cols = np.triu_indices(n - 1)
    first = rest[1:n]
    return rest[n:] - reciprocal[None] * first[rows] * first[cols]


def _row_weights(row: Array, reciprocal: Array, *later: Array) -> Array:
    """The weights (m,) of an unknown: from its row when it was eliminated, and later weights."""
    end = 1 + len(later)
    remainder = row[end:]
    for factor, weights in zip(row[1:end], later, strict=True):
        remainder = remainder - factor[None] * weights
    return remainder * reciprocal[None]


def _least_pivot(packed: Array) -> Array:
    """Below this a pivot counts as zero."""
    return 8 * order(packed) * float(jnp.finfo(packed.dtype).eps) * diagonal(packed)


@jax.custom_jvp
def _inverse_swept(packed: Array) -> Array:
    return _swept_all(packed)


@_inverse_swept.defjvp
def _inverse_jvp(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    result = _inverse_swept(*primals)
    return result, -congruence(unpack(result), *tangents)


@kernel
def _swept_all(packed: Array) -> Array:
    """Gauss-Jordan elimination without exchanges; zero rows where there is no pivot."""
    n, batch, least = order(packed), packed.ndim - 1, _least_pivot(packed)
    for k in range(n):
        packed = stage(_sweep_step(n, k), packed, least[k], batch=batch)
    return -packed


@cache
def _sweep_step(n: int, k: int) -> Callable[[Array, Array], Array]:
    rows, cols = np.triu_indices(n)

    def swept(packed: Array, least: Array) -> Array:
        """Exchanges the roles of unknown and right-hand side number k."""
        shape = (-1, *(1,) * (packed.ndim - 1))
        pivot = packed[places(n)[k, k]]
        reciprocal = _pivot_reciprocal(pivot, least)
        left = jnp.where((rows == k).reshape(shape), -1, packed[places(n)[k, rows]])
        right = jnp.where((cols == k).reshape(shape), -1, packed[places(n)[k, cols]])
        # One formula for the whole triangle: with -1 in place of the pivot's own row and column,
        # the pivot becomes -1/p, its row row/p, and the rest is reduced. After all sweeps the
        # matrix is -P^-1.
        others = jnp.where(((rows == k) | (cols == k)).reshape(shape), 0, packed)
        return others - reciprocal[None] * left * right

    return swept


@kernel
def _no_negative(packed: Array) -> Array:
    rows, cols = np.triu_indices(order(packed))
    variances = (rows == cols).reshape(-1, *(1,) * (packed.ndim - 1))
    return jnp.where(variances & (packed < 0), 0, packed)


@cache
def _rows_kernel(where: Pattern | None) -> Callable[[Array, Array], Array]:
    return kernel(lambda a, packed: _left_product(a, packed, where))


@cache
def _congruence_kernel(where: Pattern | None) -> Callable[[Array, Array], Array]:
    return kernel(lambda a, packed: _moved_packed(a, packed, where))


@cache
def _half_product(where: Pattern | None) -> Callable[[Array, Array], Array]:
    return lambda a, packed: _left_product(a, packed, where)


def _left_product(a: Array, packed: Array, where: Pattern | None) -> Array:
    """a P (m, n)."""
    if packed.ndim == 1:
        return multiplied(a, _spread_full(packed))
    at = places(a.shape[1])
    return total(f[:, None] * packed[at[k]] for f, k in by_row(a, where or full(*a.shape[:2])))


def _moved_packed(a: Array, packed: Array, where: Pattern | None) -> Array:
    """a P a', packed."""
    n, batch = a.shape[0], packed.ndim - 1
    where = where or full(n, n)
    if batch == 0:
        return _pick_upper(multiplied(multiplied(a, _spread_full(packed)), a.T))
    # A shared dense a: vec(a P a') = (a x a) vec(P) is one product with all runs as columns. A
    # sparse one takes fewer operations term by term.
    if a.size == n * n and 2 * sum(map(sum, where)) > n * n:
        return _shared_congruence(a, packed)
    # a P first, then (a P) a': two loops of n terms. As one expression each element would be a sum
    # of n^2 terms, which XLA cuts into loops that threads share (fast/README.md: "Loops inside a
    # step stay undivided").
    half = stage(_half_product(where), a, packed, batch=batch)
    rows, cols = np.triu_indices(n)
    return total(half[rows, k[cols]] * f[cols] for f, k in by_row(a, where))


def _shared_congruence(a: Array, packed: Array) -> Array:
    """a P a' as one product with the second power of an a without a batch."""
    power = stage(_second_power, a, batch=packed.ndim - 1).reshape(len(packed), len(packed))
    moved = lax.dot(power, packed.reshape(len(packed), -1), precision=lax.Precision.HIGHEST)
    return moved.reshape(packed.shape)


def _second_power(a: Array) -> Array:
    """What each element of P counts in each element of a P a', both packed."""
    rows, cols = np.triu_indices(a.shape[0])
    i, j, k, m = rows[:, None], cols[:, None], rows[None], cols[None]
    # (a P a')_ij = sum_km a_ik P_km a_jm. A packed P_km with k != m stands for two elements, k m
    # and m k.
    different = jnp.asarray(k != m, a.dtype).reshape(k.shape + (1,) * (a.ndim - 2))
    return a[i, k] * a[j, m] + different * a[i, m] * a[j, k]
