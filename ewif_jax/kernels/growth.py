"""Growing variances, within what their dtype can square and divide by."""

import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from ewif_jax.types import DTypeLike


def largest_variance(dtype: DTypeLike) -> float:
    """How large a variance may become. The derivative of an update divides by squares of variances:
    they and their reciprocals have to be ordinary numbers."""
    return float(jnp.finfo(dtype).max) ** 0.4


def grown(variances: Array, growth: Array | float) -> Array:
    """Variances times `growth`, but no larger than `largest_variance`.

    So what was known does not become nothing bit by bit, and its derivatives stay finite. What is
    infinite, or grows without bound at once, becomes infinite.
    """
    growth = jnp.asarray(growth, variances.dtype)
    ceiling = largest_variance(variances.dtype)
    fits = variances <= ceiling / growth
    larger = jnp.where(fits, variances, 0) * jnp.where(fits, growth, 1)
    larger = jnp.where(fits, larger, jnp.maximum(lax.stop_gradient(variances), ceiling))
    return jnp.where(jnp.isfinite(growth) & ~jnp.isinf(variances), larger, growth + variances)


def exponential(age: Array, tau: Array) -> Array:
    """exp(age / tau), saturated at `largest_variance` (either way), with derivatives; infinite
    where the weight exp(-age / tau) underflows: nothing is known any more."""
    dtype = jnp.result_type(age, tau)
    most = float(np.log(largest_variance(dtype)))
    forgotten = age / tau > float(np.log(float(jnp.finfo(dtype).max)))
    return jnp.where(forgotten, jnp.inf, jnp.exp(jnp.clip(age / tau, -most, most)))


def reciprocal_square(weight: Array) -> Array:
    """1 / weight^2, infinite for a weight of zero and saturated for one that is very small."""
    square = jnp.square(weight)
    return jnp.where(square == 0, jnp.inf, bounded_reciprocal(square))


def bounded_reciprocal(x: Array) -> Array:
    """1 / x, saturated at `largest_variance`."""
    most = largest_variance(x.dtype)
    usable = x > 1 / most
    return jnp.where(usable, 1 / jnp.where(usable, x, 1), jnp.where(jnp.isnan(x), x, most))
