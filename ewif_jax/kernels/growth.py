"""Growing variances, within what their dtype can square and divide by."""

from collections.abc import Callable

import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from ewif_jax.types import DTypeLike

Fade = Callable[[Array], Array]
"""From variances (n,) to what they are after a while."""
SHORT = 0.5
"""In units of tau: what an interval adds to a variance is less than the variance."""


def largest_variance(dtype: DTypeLike) -> float:
    """How large a variance may become. The derivative of an update divides by squares of variances:
    they and their reciprocals have to be ordinary numbers."""
    # 0.4 and not 0.5: a square (0.8) times a few numbers of ordinary size still has to fit.
    return float(jnp.finfo(dtype).max) ** 0.4


def grown(variances: Array, growth: Array | float) -> Array:
    """Variances times `growth`, but no larger than `largest_variance`.

    So what was known does not become nothing bit by bit, and its derivatives stay finite. What is
    infinite, or grows without bound at once, becomes infinite.
    """
    growth = jnp.asarray(growth, variances.dtype)
    ceiling = largest_variance(variances.dtype)
    # Asked before multiplying: the product might overflow, and its derivative would be inf times 0.
    fits = variances <= ceiling / growth
    larger = jnp.where(fits, variances, 0) * jnp.where(fits, growth, 1)
    # Saturated values have no derivative: growing further changes nothing.
    larger = jnp.where(fits, larger, jnp.maximum(lax.stop_gradient(variances), ceiling))
    return jnp.where(jnp.isfinite(growth) & ~jnp.isinf(variances), larger, growth + variances)


def decayed(variances: Array, age: Array, tau: Array) -> Array:
    """`grown` by `exponential(age, tau)`.

    Over many short intervals the factor is nearly 1 and the same, and so is what it was rounded by:
    a thousand steps of tau / 1000 would be as a tau off by 3e-5 of itself in float32. What is added
    is rounded anew every time.
    """
    ratio = age / tau
    is_short = (jnp.abs(ratio) < SHORT) & (variances < largest_variance(variances.dtype) / 2)
    kept = jnp.where(is_short, variances, 0)
    added = jnp.expm1(jnp.where(jnp.abs(ratio) < SHORT, ratio, 0)).astype(variances.dtype)
    return jnp.where(is_short, kept + kept * added, grown(variances, exponential(age, tau)))


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
