"""Mixtures of estimates: weights in logarithms, and the moments of all together.

The members are the first axis, which is short: kernels, so that in a batch a sum over them is a sum
of long vectors.
"""

import jax.numpy as jnp
from jax import Array, lax

from ewif_jax.fast.batched import kernel, stacked
from ewif_jax.models.angles import Angles, centre_of, wrapped_state

FARTHEST = 80.0
"""What a logarithm may be above the one that counts: its exponential is still a number."""


@kernel
def together(*members: Array) -> Array:
    """Arrays of floats, one of each member, along a new first axis."""
    return stacked(members)


def _log_sum(x: Array) -> Array:
    highest = jnp.max(x, 0)
    level = jnp.where(jnp.isfinite(highest), highest, 0)
    level = lax.stop_gradient(level)
    finite = jnp.where(jnp.isfinite(x), x, 0)
    total = jnp.sum(jnp.where(jnp.isfinite(x), jnp.exp(finite - level[None]), 0), 0)
    return jnp.where(total > 0, jnp.log(jnp.where(total > 0, total, 1)) + level, -jnp.inf)


@kernel
def log_sum(x: Array) -> Array:
    """log sum exp of numbers of which some may be -inf; -inf of nothing, with derivative 0."""
    return _log_sum(x)


@kernel
def normalised_weights(log_weights: Array) -> Array:
    """Logarithms of weights whose sum is one (as they are, if all are zero)."""
    total = _log_sum(log_weights)
    return log_weights - jnp.where(jnp.isfinite(total), total, 0)[None]


def log_of(weights: Array) -> Array:
    """The logarithms, -inf of zero with derivative 0."""
    positive = weights > 0
    return jnp.where(positive, jnp.log(jnp.where(positive, weights, 1)), -jnp.inf)


@kernel
def passed_on(log_weights: Array, chances: Array) -> tuple[Array, Array]:
    """Log weights (M,) after member i has gone over to j with `chances` (M, M)[i, j], and what
    share of j comes from i, (M, M)[i, j]; 0 of a j to which nothing goes."""
    log_weights = log_weights[:, None]
    goes = (chances > 0) & jnp.isfinite(log_weights)
    level = jnp.max(jnp.where(goes, log_weights, -jnp.inf), 0)
    level = lax.stop_gradient(jnp.where(jnp.isfinite(level), level, 0))
    # Counted from the largest weight that goes to j, so that none underflows; a chance of zero is
    # multiplied and not left out: its derivative is not zero.
    finite = jnp.where(jnp.isfinite(log_weights), log_weights, 0)
    sizes = jnp.exp(jnp.minimum(finite - level[None], FARTHEST))
    parts = chances * jnp.where(jnp.isfinite(log_weights), sizes, 0)
    total = jnp.sum(parts, 0)
    reached = total > 0
    passed = jnp.where(reached, jnp.log(jnp.where(reached, total, 1)) + level, -jnp.inf)
    return passed, parts / jnp.where(reached, total, 1)[None]


def mixed_moments(
    weights: Array, is_awake: Array, means: Array, covs: Array, angle: Angles = None
) -> tuple[Array, Array]:
    """Mean (n,) and covariance (n, n) of a mixture of those members that know the state; `angle`
    says which components are mixed on the circle."""
    means = jnp.where(is_awake[:, None], means, 0)
    covs = jnp.where(is_awake[:, None, None], covs, 0)
    awake = is_awake.astype(weights.dtype)
    if angle is None:
        return _moments(weights, awake, means, covs)
    centre = centre_of(angle, means.T, weights)
    around = wrapped_state(angle, (means - centre[None]).T).T
    shift, cov = _moments(weights, awake, around, covs)
    return centre + shift, cov


@kernel
def _moments(weights: Array, awake: Array, means: Array, covs: Array) -> tuple[Array, Array]:
    mean = jnp.sum(weights[:, None] * means, 0)
    # By `awake` and not by the weight: the derivative in a weight of zero is not zero.
    apart = jnp.where(awake[:, None] > 0, means - mean[None], 0)
    # The law of total covariance: means that disagree are uncertainty too.
    spread = covs + apart[:, :, None] * apart[:, None, :]
    return mean, jnp.sum(weights[:, None, None] * spread, 0)
