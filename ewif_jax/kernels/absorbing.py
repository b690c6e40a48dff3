"""Further equations, added to what is known of a state (`kernels.equations`) one by one."""

from collections.abc import Callable
from functools import cache

import jax.numpy as jnp
from jax import Array, lax

from ewif_jax.fast.batched import kept_apart, kernel, stacked, stage
from ewif_jax.kernels.equations import by_equation

FEW = 4
"""Components of a measurement, which are written out; a window or a whole state is a loop."""


def absorbed(
    variances: Array, rows: Array, equations: Array, noises: Array, sizes: Array | None = None
) -> tuple[Array, Array, Array, Array]:
    """Variances and rows with further `equations` (m, n), whose errors have variances `noises`
    (m,). `sizes` (m, n) of the terms that their coefficients were summed from, where they may
    cancel.

    Also leads and steps (m, n): what `answered` needs to do the same to the targets, which are the
    only part that depends on data. A direction about which nothing is known is learnt from an
    equation only where that is more than the rounding of taking out what is known.
    """
    sizes = jnp.abs(equations) if sizes is None else sizes
    return _absorbed(variances, rows, equations, noises, sizes)


def answered(targets: Array, residuals: Array, leads: Array, steps: Array) -> Array:
    """The targets with further equations, which say `residuals` (m,)."""
    return _answered(targets, residuals, leads, steps)


@kernel
def _absorbed(
    variances: Array, rows: Array, equations: Array, noises: Array, sizes: Array
) -> tuple[Array, Array, Array, Array]:
    batch = noises.ndim - 1
    if len(noises) == 1:
        one = _one_absorbed(variances, rows, equations[0], noises[0], sizes[0], batch)
        return one[0], one[1], one[2][None], one[3][None]
    # A loop, although it has a few rounds only: written out, each would be compiled by itself.
    variances, rows, *new = _alike(batch, variances, rows, equations, noises, sizes)

    def add(
        before: tuple[Array, Array], new: tuple[Array, Array, Array]
    ) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
        kept, changed, leads, steps = _one_absorbed(*before, *new, batch)
        return (kept, changed), (leads, steps)

    kept, told = lax.scan(add, (variances, rows), (new[0], new[1], new[2]))
    return *kept, *told


def _alike(batch: int, *arrays: Array) -> list[Array]:
    """The arrays with equal trailing axes, which a loop's states must keep."""
    runs = jnp.broadcast_shapes(*(x.shape[x.ndim - batch :] for x in arrays))
    return [jnp.broadcast_to(x, x.shape[: x.ndim - batch] + runs) for x in arrays]


def _one_absorbed(
    variances: Array, rows: Array, equation: Array, noise: Array, scale: Array, batch: int
) -> tuple[Array, Array, Array, Array]:
    # What is left of the equation for each row has to be found one row after the other, and is all
    # that is: variances are computed for all rows at once, which compiles in half the time.
    n = equation.shape[0]
    # Scales are compared with, and nothing else: they need no derivatives.
    scale = lax.stop_gradient(scale)
    unknown = jnp.isinf(variances)
    finite = jnp.where(unknown, 0, variances)
    before = by_equation(rows, n)
    leads, noises, rests = [], [], []
    for k, row in enumerate(before):
        noises.append(noise)
        lead, noise = stage(
            _lead_at(n), variances[k], finite[k], noise, equation[0], scale[0], batch=batch
        )
        leads.append(lead)
        if k < n - 1:
            equation = stage(_left_of, row, equation[1:], lead, batch=batch)
            scale = stage(_scale_after, lax.stop_gradient(row), scale, batch=batch)
            rests.append(equation)
    lead, noise = stacked(leads), stacked(noises)
    kept, steps = stage(_learnt_variances, variances, finite, noise, lead, batch=batch)
    if n == 1:
        return kept, rows, lead, steps
    # The last equation has no further coefficient.
    pairs = enumerate(zip(before[:-1], rests, strict=True))
    changed = [stage(_corrected_row, row, rest, steps[k], batch=batch) for k, (row, rest) in pairs]
    return kept, jnp.concatenate(changed), lead, steps


@cache
def _lead_at(n: int) -> Callable[..., tuple[Array, Array]]:
    """The coefficient of an equation at a row, 0 where it is only rounding, and the noise that what
    is left of the equation has after it: r + lead^2 v, and infinite once a row that says nothing
    has used it up."""

    def lead_at(
        variance: Array, finite: Array, noise: Array, lead: Array, scale: Array
    ) -> tuple[Array, Array]:
        rounding = 8 * n * float(jnp.finfo(lead.dtype).eps) * scale
        # What an exact equation says by rounding alone would be believed. Several have rounded it.
        bound = jnp.where(jnp.isinf(variance), 1, 8) * rounding
        is_rounding = (jnp.abs(lead) <= bound) & (noise <= bound * (bound * variance))
        lead = jnp.where(is_rounding, 0, lead)
        used_up = jnp.isinf(variance) & (lead != 0)
        return lead, jnp.where(used_up, jnp.inf, noise + lead * (lead * finite))

    return kept_apart(lead_at)


@kept_apart
def _left_of(row: Array, rest: Array, lead: Array) -> Array:
    return rest - lead[None] * row


@kept_apart
def _scale_after(row: Array, scale: Array) -> Array:
    # The rounding of the lead, however little of it is left, is in all that it takes out.
    return jnp.maximum(scale[1:], scale[0][None] * jnp.abs(row))


@kept_apart
def _learnt_variances(
    variances: Array, finite: Array, noise: Array, lead: Array
) -> tuple[Array, Array]:
    """Variances (n,), and by how much of what is left of the equation each row changes.

    With variance v and noise r: v r / (r + lead^2 v) and lead v / (r + lead^2 v); of a row that
    says nothing r / lead^2 and 1 / lead.
    """
    unknown, telling = jnp.isinf(variances), ~jnp.isinf(noise)
    r = jnp.where(telling, noise, 0)
    S = r + lead * (lead * finite)
    some = S > 0
    q = jnp.where(some, 1 / jnp.where(some, S, 1), 0)
    again = finite * jnp.where(some, r * q, 1)
    fresh = unknown & telling & (lead != 0)
    inverted = jnp.where(fresh, 1 / jnp.where(fresh, lead, 1), 0)
    first = jnp.where(fresh, r * inverted * inverted, jnp.inf)
    return (
        jnp.where(unknown, first, jnp.where(telling, again, finite)),
        jnp.where(unknown, inverted, jnp.where(telling, lead * (finite * q), 0)),
    )


@kept_apart
def _corrected_row(row: Array, rest: Array, step: Array) -> Array:
    changed = row + step[None] * rest
    # What an exact equation replaces leaves rounding, which the next would take for its own.
    rounding = 8 * (len(row) + 1) * float(jnp.finfo(row.dtype).eps) * jnp.abs(row)
    return changed - lax.stop_gradient(jnp.where(jnp.abs(changed) < rounding, changed, 0))


@kernel
def _answered(targets: Array, residuals: Array, leads: Array, steps: Array) -> Array:
    batch = residuals.ndim - 1
    if len(residuals) <= FEW:
        for residual, lead, step in zip(residuals, leads, steps, strict=True):
            targets = _one_answered(targets, residual, lead, step)
        return targets
    targets, *new = _alike(batch, targets, residuals, leads, steps)

    def answer(before: Array, new: tuple[Array, Array, Array]) -> tuple[Array, None]:
        return _one_answered(before, *new), None

    return lax.scan(answer, targets, (new[0], new[1], new[2]))[0]


def _one_answered(targets: Array, residual: Array, leads: Array, steps: Array) -> Array:
    # Number by number: as vectors the slopes take four times as long (docs/decisions/fast.md).
    left, found = residual, []
    for target, lead, step in zip(targets, leads, steps, strict=True):
        left = left - lead * target
        found.append(target + step * left)
    return stacked(found)
