"""The measurement update of a Gaussian: masked, singular-safe, Joseph-stabilised."""

from collections.abc import Callable
from functools import cache, reduce
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from ewif_jax import checks
from ewif_jax.fast.batched import kernel, total
from ewif_jax.fast.small import matmul
from ewif_jax.fast.sparse import (
    Matrix,
    Pattern,
    apart,
    by_row,
    dense,
    elementwise,
    full,
    multiplied,
)
from ewif_jax.kernels import cholesky, symmetric


class Innovation(NamedTuple):
    """What a measurement is compared with: value (m,), cov (m, m), its factor, and H P (m, n)."""

    value: Array
    cov: Array
    factor: cholesky.Factor
    cross: Array


def mask_cov(cov: Array, mask: Array) -> Array:
    """`cov` with identity rows and columns where `mask` is False."""
    both = mask[:, None] & mask[None, :]
    return jnp.where(both, cov, jnp.eye(cov.shape[0], dtype=cov.dtype))


def innovate(
    difference: Array, cross: Array, cov: Array, mask: Array, size: Array | None = None
) -> Innovation:
    """The innovation with absent components taken out: zero difference and gain, unit variance.
    `size` (m,) of the terms that the variances were summed from, if larger (see `sizes`)."""
    cov = mask_cov(cov, mask)
    return Innovation(
        jnp.where(mask, difference, 0),
        cov,
        cholesky.factor(cov, size=size),
        jnp.where(mask[:, None], cross, 0),
    )


def log_density(innovation: Innovation, mask: Array) -> Array:
    """log N(value; 0, cov) over the components that exist and are not known already.

    A component whose variance is zero given the ones before it has no density: it tells nothing,
    moves nothing (see `cholesky.factor`), and counts 0.
    """
    white = cholesky.forward(innovation.factor, innovation.value)
    count = jnp.sum(mask & (innovation.factor.reciprocal > 0)).astype(white.dtype)
    half_log_det = cholesky.half_log_det(innovation.factor)
    return -0.5 * (jnp.sum(jnp.square(white)) + count * jnp.log(2 * jnp.pi)) - half_log_det


def squared_distance(error: Array, cov: Array) -> Array:
    """error' cov^-1 error () of error (m,) and cov (m, m), over the directions whose variance is
    not zero; NaN where either is not finite."""
    all_finite = jnp.all(jnp.isfinite(error)) & jnp.all(jnp.isfinite(cov))
    safe = jnp.where(all_finite, cov, jnp.eye(cov.shape[0], dtype=cov.dtype))
    white = cholesky.forward(cholesky.factor(safe), jnp.where(all_finite, error, 0))
    return jnp.where(all_finite, white @ white, jnp.nan)


def gain(innovation: Innovation) -> Array:
    """K = P H' S^-1, (n, m)."""
    return cholesky.solve(innovation.factor, innovation.cross).T


def update(
    mean: Array,
    packed: Array,
    difference: Array,
    H: Array | Matrix,
    R: Array,
    mask: Array,
) -> tuple[Array, Array, Innovation]:
    """Mean and packed covariance after a linear(ised) measurement, with the innovation.

    `difference` (m,) is measured minus predicted, H (m, n), R (m, m), mask (m,). The covariance is
    (I - K H) P (I - K H)' + K R K' in two low-rank steps. The second uses H applied to the rounded
    result of the first, which is what makes the Joseph form forget rounding errors of the gain.
    What P itself was rounded by it cannot forget: where that exceeds a variance that is left (a
    prior 1/eps times as wide as R), the variance is 0, never negative. So is one that an exact
    measurement leaves: its rounding would be weighed like knowledge by the next such measurement.
    """
    H = elementwise(lambda H: jnp.where(mask[:, None], H, 0), H)
    is_exact_nowhere = _is_noise(R)
    R = mask_cov(R, mask)
    cross = symmetric.rows(H, packed)
    values, where = apart(H)
    cov = _expected_cov(where)(cross, values, R)
    factor = cholesky.factor(cov, size=sizes(packed, H, R))
    innovation = Innovation(jnp.where(mask, difference, 0), cov, factor, cross)
    weights = cholesky.solve(innovation.factor, cross)
    mean = _moved_mean(mean, weights, innovation.value)
    # P - P H' K' first, then + K (R K' - H half): the same as Joseph's product, but two low-rank
    # steps on the triangle in place of two n x n products.
    half = _packed_less(packed, cross, weights)
    left_over = _left_over(R, weights, symmetric.rows(H, half))
    if is_exact_nowhere:
        return mean, _packed_sum(half, weights, left_over), innovation
    least = _least_share(mean.shape[0])(R, cov)
    return mean, _packed_more(packed, half, weights, left_over, least), innovation


def _is_noise(R: Array) -> bool:
    """Whether every component is known, while tracing, to be measured with noise. Nothing has to be
    compared with the rounding of an exact measurement then, which is a tenth of a batch's time."""
    noise = checks.concrete_value(R)
    return noise is not None and bool((np.diagonal(noise) > 0).all())


def rounding_of(predicted: Array) -> Array:
    """Deviations (m,) from a prediction that are no more than what a few operations round it by."""
    return 64 * jnp.finfo(predicted.dtype).eps * jnp.abs(predicted)


def sizes(packed: Array, H: Array | Matrix, R: Array) -> Array | None:
    """R_kk plus n times the sum of H_ki^2 P_ii, (m,): how large the terms are, together, that may
    cancel in H P H' + R. None where there is one term only. H and R are masked."""
    where = apart(H)[1]
    if where is not None and max(map(sum, where)) <= 1:
        return None
    return _term_sizes(packed, dense(H), R)


@kernel
def _term_sizes(packed: Array, H: Array, R: Array) -> Array:
    m, n = H.shape[:2]
    variances = packed[_diagonal_places(n)]
    noise = jnp.stack([R[k, k] for k in range(m)])
    return noise + n * total(jnp.square(H[:, i]) * variances[i][None] for i in range(n))


@cache
def _expected_cov(where: Pattern | None) -> Callable[[Array, Array, Array], Array]:
    @kernel
    def expected(cross: Array, H: Array, R: Array) -> Array:
        """H P H' + R, from H P."""
        if H.ndim == 2:
            return R + multiplied(cross, H.T)
        terms = by_row(H, where or full(*H.shape[:2]))
        return R + total(cross[:, column] * factor[None] for factor, column in terms)

    return expected


def update_from_afar(
    mean: Array,
    packed: Array,
    difference: Array,
    cross: Array,
    spread: Array,
    R: Array,
    mask: Array,
    size: Array | None = None,
) -> tuple[Array, Array, Innovation]:
    """`update` by a measurement of something else: `cross` (m, n) is its covariance with the state,
    `spread` (m, m) its own without noise, `size` as in `innovate`."""
    innovation = innovate(difference, cross, spread + R, mask, size)
    weights = cholesky.solve(innovation.factor, innovation.cross)
    mean = _moved_mean(mean, weights, innovation.value)
    half = _packed_less(packed, innovation.cross, weights)
    seen = innovation.cross - matmul(jnp.where(mask[:, None] & mask[None, :], spread, 0), weights)
    R = mask_cov(R, mask)
    least = _least_share(mean.shape[0])(R, innovation.cov)
    return (
        mean,
        _packed_more(packed, half, weights, _left_over(R, weights, seen), least),
        innovation,
    )


@kernel
def _moved_mean(mean: Array, weights: Array, value: Array) -> Array:
    """mean + K value, with K' = weights."""
    return mean + _contract_first(weights, value[:, None])


@kernel
def _packed_less(packed: Array, cross: Array, weights: Array) -> Array:
    """P - P H' K', packed."""
    rows, cols = np.triu_indices(cross.shape[1])
    return packed - _contract_first(cross[:, rows], weights[:, cols])


@kernel
def _left_over(R: Array, weights: Array, seen: Array) -> Array:
    """R K' - H half; `seen` = H half."""
    return _contract_first(R[:, :, None], weights[:, None, :]) - seen


@kernel
def _packed_sum(half: Array, weights: Array, left_over: Array) -> Array:
    """half + K left_over, packed, no variance below 0."""
    rows, cols = np.triu_indices(weights.shape[1])
    return symmetric.no_negative(half + _contract_first(weights[:, rows], left_over[:, cols]))


@kernel
def _packed_more(
    packed: Array, half: Array, weights: Array, left_over: Array, least: Array
) -> Array:
    """half + K left_over, packed, no variance below 0, and none of what is less than `least` () of
    what it was, which is rounding. Its derivatives stay."""
    rows, cols = np.triu_indices(weights.shape[1])
    cov = half + _contract_first(weights[:, rows], left_over[:, cols])
    rounding = jnp.where(jnp.abs(cov) < least[None] * jnp.abs(packed), cov, 0)
    return symmetric.no_negative(cov - lax.stop_gradient(rounding))


def cleared(packed: Array, before: Array, R: Array, innovation_cov: Array) -> Array:
    """A packed covariance after a measurement without what is only rounding of the one before."""
    least = _least_share(symmetric.order(packed))(R, innovation_cov)
    return packed - lax.stop_gradient(
        jnp.where(jnp.abs(packed) < least * jnp.abs(before), packed, 0)
    )


@cache
def _least_share(n: int) -> Callable[[Array, Array], Array]:
    """Which share of a covariance (n, n) is rounding after a measurement of noise R and innovation
    covariance `cov`: Joseph's form leaves the square of what the covariance was rounded by. Where
    nothing but exact components is seen, even its rounding is larger than all that is right."""

    @kernel
    def least(R: Array, cov: Array) -> Array:
        share = cholesky.negligible(n, cov.dtype)
        noise, spread = ([x[k, k] for k in range(x.shape[0])] for x in (R, cov))
        exact = [r == 0 for r in noise]
        # What is absent has the same of both.
        nothing_else = [e | (r == s) for e, r, s in zip(exact, noise, spread, strict=True)]
        some, only = (
            reduce(op, x) for op, x in ((jnp.logical_or, exact), (jnp.logical_and, nothing_else))
        )
        # Noise, however small beside what was known, makes no variance that is rounding alone.
        return jnp.where(some, jnp.where(only, 64 * share, share**2), 0).astype(cov.dtype)

    return least


def _diagonal_places(n: int) -> np.ndarray:
    return np.diagonal(symmetric.places(n))


def _contract_first(a: Array, b: Array) -> Array:
    """The sum of a b over their first axis."""
    return total(a[k] * b[k] for k in range(a.shape[0]))
