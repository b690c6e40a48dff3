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

import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from ewif_jax.fast.batched import kept_apart, kernel, stacked, stage, total
from ewif_jax.fast.sparse import Pattern, by_row
from ewif_jax.kernels import cholesky
from ewif_jax.types import DTypeLike


def solved(rows: Array, targets: Array) -> Array:
    """The solution (n,) of the equations."""
    return _solved(rows, targets)


def times(rows: Array, x: Array) -> Array:
    """What the left-hand sides (n,) are at x (n,)."""
    return _times(rows, x)


def absorbed(
    variances: Array, rows: Array, equation: Array, noise: Array, size: Array | None = None
) -> tuple[Array, Array, Array, Array]:
    """Variances and rows with one more `equation` (n,), whose error has variance `noise` ().
    `size` (n,) of the terms that its coefficients were summed from, where they may cancel.

    Also leads and steps (n,): what `answered` needs to do the same to the targets, which are the
    only part that depends on data. A direction about which nothing is known is learnt from an
    equation only where that is more than the rounding of taking out what is known.
    """
    sizes = () if size is None else (size,)
    return _absorbed(variances, rows, equation, noise, *sizes)


def answered(targets: Array, residual: Array, leads: Array, steps: Array) -> Array:
    """The targets with one more equation, which says `residual` ()."""
    return _answered(targets, residual, leads, steps)


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
    # In reverse order the lower factor is an upper one: P = U U', and U^-1 holds the equations.
    found = cholesky.factor(cov[::-1, ::-1])
    unit = (found.lower * found.reciprocal[None])[::-1, ::-1]
    variances = jnp.square(jnp.diagonal(found.lower)[::-1])
    floors = least_share(len(cov), cov.dtype) * jnp.diagonal(cov)
    return jnp.maximum(variances, floors), strict(inverse(strict(unit)))


def carried(rows: Array, back: Array, where: Pattern) -> tuple[Array, Array]:
    """Rows after x <- back x' for an upper triangular matrix `back` that may differ from zero
    `where`, and the diagonal (n,) of back, by which the targets have to be divided."""
    return _carried(where)(rows, back)


def is_upper(where: Pattern | None) -> bool:
    """Whether a pattern is known to be upper triangular."""
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


def _pieces(rows: Array, n: int) -> list[Array]:
    ends = np.cumsum([0, *range(n - 1, -1, -1)])
    return [rows[a:b] for a, b in pairwise(ends)]


@kernel
def _solved(rows: Array, targets: Array) -> Array:
    n, found = targets.shape[0], []
    for k, row in reversed(list(enumerate(_pieces(rows, n)))):
        terms = [targets[k], *(-row[j] * x for j, x in enumerate(found))]
        found.insert(0, total(terms))
    return stacked(found)


@kernel
def _times(rows: Array, x: Array) -> Array:
    n = x.shape[0]
    pieces = enumerate(_pieces(rows, n))
    return stacked(
        [total([x[k], *(row[j] * x[k + 1 + j] for j in range(n - 1 - k))]) for k, row in pieces]
    )


def _weighed(v: Array, r: Array, lead: Array) -> tuple[Array, Array, Array]:
    """v r / S, S = r + lead^2 v and lead v / S; v, S and 0 where S is 0."""
    S, _, a, b = _shares(v, r, lead)
    return v * a, S, b


def _shares(v: Array, r: Array, lead: Array) -> tuple[Array, Array, Array, Array]:
    """S, 1 / S, r / S and lead v / S."""
    S = r + lead * (lead * v)
    some = S > 0
    q = jnp.where(some, 1 / jnp.where(some, S, 1), 0)
    return S, q, jnp.where(some, r * q, 1), lead * (v * q)


@kernel
def _absorbed(
    variances: Array, rows: Array, equation: Array, noise: Array, size: Array | None = None
) -> tuple[Array, Array, Array, Array]:
    n, batch = equation.shape[0], equation.ndim - 1
    scale, found = jnp.abs(equation) if size is None else size, []
    for k, row in enumerate(_pieces(rows, n)):
        variance, noise, lead, step = stage(
            _met(n), variances[k], noise, equation[0], scale[0], batch=batch
        )
        if k < n - 1:
            row, equation, scale = stage(
                _taken_out, row, equation[1:], scale[1:], lead, step, batch=batch
            )
        found.append((variance, row, lead, step))
    return _together(found, rows)


def _together(
    found: list[tuple[Array, Array, Array, Array]], rows: Array
) -> tuple[Array, Array, Array, Array]:
    variances, leads, steps = (stacked([x[i] for x in found]) for i in (0, 2, 3))
    runs = jnp.broadcast_shapes(variances.shape[1:], rows.shape[1:])
    parts = [jnp.broadcast_to(x[1], (len(x[1]), *runs)) for x in found]
    return variances, jnp.concatenate(parts), leads, steps


@cache
def _met(n: int) -> Callable[..., tuple[Array, ...]]:
    """What happens to the variance of row k and to the noise of an equation with coefficient `lead`
    there, and by how much of what is left of the equation the row changes.

    With variance v and noise r: v r / (r + lead^2 v), r + lead^2 v, and lead v / (r + lead^2 v); of
    a row that says nothing r / lead^2, infinite (the equation is used up), and 1 / lead.
    """

    def met(variance: Array, noise: Array, lead: Array, scale: Array) -> tuple[Array, ...]:
        unknown, telling = jnp.isinf(variance), ~jnp.isinf(noise)
        v, r = jnp.where(unknown, 0, variance), jnp.where(telling, noise, 0)
        rounding = 8 * n * float(jnp.finfo(lead.dtype).eps) * scale
        lead = jnp.where(unknown & (jnp.abs(lead) <= rounding), 0, lead)
        # What an exact equation says by rounding alone would be believed. Several have rounded it.
        rounding = jnp.where(unknown, 0, 8 * rounding)
        blind = (r <= rounding * (rounding * v)) & (jnp.abs(lead) <= rounding)
        lead = jnp.where(blind, 0, lead)
        again, both, step = _weighed(v, r, lead)
        fresh = unknown & telling & (lead != 0)
        inverted = jnp.where(fresh, 1 / jnp.where(fresh, lead, 1), 0)
        first = jnp.where(fresh, r * inverted * inverted, jnp.inf)
        return (
            jnp.where(unknown, first, jnp.where(telling, again, v)),
            jnp.where(fresh | ~telling, jnp.inf, both),
            lead,
            jnp.where(unknown, inverted, jnp.where(telling, step, 0)),
        )

    return kept_apart(met)


@kept_apart
def _taken_out(
    row: Array, rest: Array, scale: Array, lead: Array, step: Array
) -> tuple[Array, Array, Array]:
    part = lead[None] * row
    rest = rest - part
    taken = row + step[None] * rest
    # What an exact equation replaces leaves rounding, which the next one would take for its own.
    rounding = 8 * (len(row) + 1) * float(jnp.finfo(row.dtype).eps) * jnp.abs(row)
    left = lax.stop_gradient(jnp.where(jnp.abs(taken) < rounding, taken, 0))
    return taken - left, rest, jnp.maximum(scale, jnp.abs(part))


@kernel
def _answered(targets: Array, residual: Array, leads: Array, steps: Array) -> Array:
    left, new = residual, []
    for k in range(targets.shape[0]):
        left = left - leads[k] * targets[k]
        new.append(targets[k] + steps[k] * left)
    return stacked(new)


@kernel
def _leading(rows: Array, equations: Array) -> Array:
    n, batch, found = equations.shape[1], equations.ndim - 2, []
    for k, row in enumerate(_pieces(rows, n)):
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
    for k, row in reversed(list(enumerate(_pieces(rows, n)))):
        tail = [stage(_less, row, *below, batch=batch)] if k < n - 1 else []
        below.insert(0, jnp.concatenate([jnp.zeros((k, *rows.shape[1:]), rows.dtype), ones, *tail]))
    return jnp.stack(below)


def _less(row: Array, *below: Array) -> Array:
    first = below[0].shape[0] - len(below)
    return -total(r[None] * b[first:] for r, b in zip(row, below, strict=True))


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
