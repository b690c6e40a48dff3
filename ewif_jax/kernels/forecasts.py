"""Scores of a Gaussian forecast beside its density: small for one that is sharp and right."""

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.scipy.special import ndtr

from ewif_jax.kernels import cholesky

NODES = 2 * np.sinh(np.linspace(-4.2, 4.2, 85))
"""Logarithms at which `mean_length` is summed: the double exponential rule (Takahasi & Mori 1974),
whose error falls exponentially with the number of nodes."""
WEIGHTS = 2 * np.cosh(np.linspace(-4.2, 4.2, 85)) * (8.4 / 84)


def gaussian_crps(error: Array, spread: Array) -> Array:
    r"""The continuous ranked probability score of N(0, spread^2) for what turned out to be `error`.

    .. math::
        \sigma \left( z (2 \Phi(z) - 1) + 2 \varphi(z) - 1/\sqrt\pi \right), \quad z = e / \sigma

    In the units of the error; its length for a forecast without spread. Elementwise.
    """
    is_wide = spread > 0
    sigma = jnp.where(is_wide, spread, 1)
    z = jnp.where(is_wide, error, 0) / sigma
    density = jnp.exp(-jnp.square(z) / 2) / np.sqrt(2 * np.pi)
    score = sigma * (z * (2 * ndtr(z) - 1) + 2 * density - 1 / np.sqrt(np.pi))
    return jnp.where(is_wide, score, jnp.abs(error))


def gaussian_energy(error: Array, cov: Array) -> Array:
    r"""The energy score of N(0, cov) for what turned out to be `error` (m,).

    .. math::
        E \| X - e \| - \tfrac12 E \| X - X' \|, \quad X, X' \sim N(0, C)

    Reduces to: `gaussian_crps` in one dimension.
    """
    return mean_length(error, cov) - mean_length(jnp.zeros_like(error), 2 * cov) / 2


def mean_length(mean: Array, cov: Array) -> Array:
    r"""E |X| of a Gaussian X.

    .. math::
        E |X| = \frac{1}{2 \sqrt\pi} \int_0^\infty t^{-3/2} \left( 1 - E e^{-t |X|^2} \right) dt,
        \quad E e^{-t |X|^2} = |1 + 2 t C|^{-1/2} e^{-t m' (1 + 2 t C)^{-1} m}
    """
    scale = jnp.trace(cov) + jnp.sum(jnp.square(mean))
    nodes = jnp.asarray(NODES, mean.dtype)
    is_spread = scale > 0
    scale = jnp.where(is_spread, scale, 1)
    # In units in which E |X|^2 is 1: what is large or small meets no end of the numbers.
    mean, cov = mean / jnp.sqrt(scale), cov / scale
    eye = jnp.eye(mean.shape[0], dtype=mean.dtype)
    small = float(jnp.finfo(mean.dtype).eps) ** (1 / 3)
    second = jnp.sum(jnp.square(cov)) + 2 * mean @ cov @ mean

    def missing(log: Array) -> Array:
        """t^(-1/2) (1 - E exp(-t |X|^2)) at t = exp(log)."""
        t = jnp.exp(log)
        factor = cholesky.factor(eye + 2 * t * cov)
        white = cholesky.forward(factor, mean)
        exponent = cholesky.half_log_det(factor) + t * jnp.sum(jnp.square(white))
        # The logarithm of 1 + t loses the digits of a small t.
        few = jnp.minimum(t, small)  # the square of a large t is infinite in float32
        # log |1 + 2 t C| / 2 + t m'(1 + 2 t C)^-1 m to second order in t: t (tr C + m'm), which is
        # t in these units, minus t^2 `second`. The neglected third order is below eps where t <
        # eps^(1/3).
        exponent = jnp.where(t < small, few - jnp.square(few) * second, exponent)
        # t^(-3/2) dt = t^(-1/2) d(log t): hence half a power of t less than in the integral.
        return -jnp.expm1(-exponent) * jnp.exp(-log / 2)

    total = jnp.sum(jnp.asarray(WEIGHTS, mean.dtype) * jax.vmap(missing)(nodes))
    length = jnp.sqrt(scale) * total / (2 * np.sqrt(np.pi))
    return jnp.where(is_spread, length, 0)
