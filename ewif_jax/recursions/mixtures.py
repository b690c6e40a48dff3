"""Mixtures of estimates: weights in logarithms, and the moments of all together."""

import jax.numpy as jnp
from jax import Array, lax

from ewif_jax.models.angles import Angles, centre_of, wrapped_state

FARTHEST = 80.0
"""What a logarithm may be above the one that counts: its exponential is still a number."""


def log_sum(x: Array) -> Array:
    """log sum exp of numbers of which some may be -inf; -inf of nothing, with derivative 0."""
    highest = jnp.max(x)
    level = jnp.where(jnp.isfinite(highest), highest, 0)
    level = lax.stop_gradient(level)
    total = jnp.sum(
        jnp.where(jnp.isfinite(x), jnp.exp(jnp.where(jnp.isfinite(x), x, 0) - level), 0)
    )
    return jnp.where(total > 0, jnp.log(jnp.where(total > 0, total, 1)) + level, -jnp.inf)


def normalised_weights(log_weights: Array) -> Array:
    """Logarithms of weights whose sum is one (as they are, if all are zero)."""
    total = log_sum(log_weights)
    return log_weights - jnp.where(jnp.isfinite(total), total, 0)


def log_of(weights: Array) -> Array:
    """The logarithms, -inf of zero with derivative 0."""
    positive = weights > 0
    return jnp.where(positive, jnp.log(jnp.where(positive, weights, 1)), -jnp.inf)


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
    if angle is None:
        mean = jnp.sum(weights[:, None] * means, 0)
        apart = means - mean[None]
    else:
        centre = centre_of(angle, means.T, weights)
        around = wrapped_state(angle, (means - centre[None]).T).T
        shift = jnp.sum(weights[:, None] * around, 0)
        mean, apart = centre + shift, around - shift[None]
    apart = jnp.where(is_awake[:, None], apart, 0)
    # The law of total covariance: means that disagree are uncertainty too.
    spread = covs + apart[:, :, None] * apart[:, None, :]
    return mean, jnp.sum(weights[:, None, None] * spread, 0)
