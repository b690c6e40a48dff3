"""Errors of estimates, and whether their covariances are honest."""

from functools import partial

import jax
import jax.numpy as jnp
from jax import Array

from ewif_jax import checks
from ewif_jax.fast.compiling import array
from ewif_jax.kernels import gaussian
from ewif_jax.types import Info


def rmse(mean: Array, truth: Array, axis: int | tuple[int, ...] | None = None) -> Array:
    r"""Root of the mean square distance, :math:`\sqrt{E \|\hat x - x\|^2}`, over `axis`.

    Args:
        mean: (..., n) estimates; only the first k components are compared.
        truth: (..., k).
        axis: axes of the leading dimensions to average over (default all).

    Steps where the estimate is NaN (nothing known yet) are left out.
    """
    return _rms_error(jnp.asarray(mean), jnp.asarray(truth), axis)


@partial(jax.jit, static_argnames="axis", inline=True)
def _rms_error(mean: Array, truth: Array, axis: int | tuple[int, ...] | None) -> Array:
    error = mean[..., : truth.shape[-1]] - truth
    all_finite = jnp.all(jnp.isfinite(error), -1)
    square = jnp.sum(jnp.square(jnp.where(all_finite[..., None], error, 0)), -1)
    count = jnp.sum(all_finite, axis)
    mean_square = jnp.sum(square, axis) / jnp.maximum(count, 1)
    safe = jnp.where(mean_square > 0, mean_square, 1)
    return jnp.where(mean_square > 0, jnp.sqrt(safe), jnp.where(count > 0, 0, jnp.nan))


def nees(mean: Array, cov: Array, truth: Array) -> Array:
    r"""Normalised estimation error squared :math:`(\hat x - x)' P^{-1} (\hat x - x)`, shape (...,).

    Args:
        mean: (..., n); cov: (..., n, n); truth: (..., k), compared with the first k components.

    Chi-square with k degrees of freedom (mean k) if the filter is consistent.
    """
    return _normalised_error(array(mean), array(cov), array(truth))


def nis(info: Info) -> Array:
    r"""Normalised innovation squared :math:`\nu' S^{-1} \nu`, shape (...,).

    Chi-square with as many degrees of freedom as components were present; 0 where none was.
    """
    return _quadratic_form(info.innovation, info.innovation_cov)


def chi2_band(dof: int, samples: int, level: float = 0.95) -> tuple[float, float]:
    """Where the mean of `samples` independent chi-square(dof) values lies with probability `level`.

    The usual two-sided acceptance band of average NEES or NIS.
    """
    from scipy.special import gammaincinv  # here: the import takes longer than the call

    checks.whole("dof", dof, 1)
    checks.whole("samples", samples, 1)
    checks.require(0 < level < 1, "level", "a probability between 0 and 1", level)
    shape = dof * samples / 2
    tail = (1 - level) / 2
    low, high = (2 * float(gammaincinv(shape, p)) / samples for p in (tail, 1 - tail))
    return low, high


@partial(jax.jit, inline=True)
def _normalised_error(mean: Array, cov: Array, truth: Array) -> Array:
    k = truth.shape[-1]
    return _quadratic_form(mean[..., :k] - truth, cov[..., :k, :k])


@partial(jax.jit, inline=True)
def _quadratic_form(error: Array, cov: Array) -> Array:
    lead = error.shape[:-1]
    flat = error.reshape(-1, error.shape[-1])
    matrices = cov.reshape(-1, *cov.shape[-2:])
    return jax.vmap(gaussian.squared_distance)(flat, matrices).reshape(lead)
