"""The exact error of a linear filter along a given truth, without sampling."""

from functools import partial

import jax
import jax.numpy as jnp
from jax import Array

from ewif_jax import checks
from ewif_jax.estimator import run
from ewif_jax.types import Estimator, Gaussian, Measurement, Numbers, Params


def expected_mse(
    estimator: Estimator,
    params: Params,
    measurements: Measurement,
    truth: Array,
    *,
    noise_cov: Numbers,
    prior: Gaussian | None,
    t0: Numbers,
    times: Numbers = None,
) -> Array:
    r"""Mean square error at every arrival: bias squared plus variance, exactly.

    A linear filter is :math:`\hat x = c + \sum_l G_l z_l`, so with
    :math:`z_l = \bar z_l + v_l,\ v_l \sim N(0, R_l)`

    .. math::
        E \|\hat x - x\|^2 = \Big\| c + \sum_l G_l \bar z_l - x \Big\|^2
            + \sum_l \operatorname{tr} G_l R_l G_l' .

    The gains G_l are read off by forward differentiation. Differentiable in `params`, so `tau` and
    the process noise can be tuned on it directly.

    Args:
        estimator: a filter whose mean is affine in the measurements.
        params: its parameters.
        measurements: stream whose `value` (T, m) is the noise-free signal.
        truth: (T, k) what the first k state components should be at each report.
        noise_cov: variance, (m, m) or (T, m, m) covariance of the noise that is really there.
        prior, t0, times: as in `run`.

    Returns:
        (T,), NaN where the filter cannot estimate yet.
    """
    value = jnp.asarray(measurements.value)
    checks.shape("measurements.value", value, ("T", "m"))
    steps, m = value.shape
    checks.shape("truth", truth, (steps, "k"))
    truth = jnp.asarray(truth, value.dtype)
    noise = jnp.asarray(noise_cov, value.dtype)
    if noise.ndim == 0:
        checks.at_least("noise_cov", noise_cov, 0.0)
        noise = noise * jnp.eye(m, dtype=value.dtype)
    if noise.ndim == 2:
        checks.psd("noise_cov", noise_cov if jnp.ndim(noise_cov) else noise)
        noise = jnp.broadcast_to(noise, (steps, m, m))
    checks.shape("noise_cov", noise, (steps, m, m))

    def filtered(value: Array) -> tuple[Array, Array]:
        stream = measurements._replace(value=value)
        trace = run(estimator, params, stream, prior=prior, t0=t0, times=times)
        mean = trace.mean[:, : truth.shape[1]]
        return mean, mean

    gains, mean = jax.jacfwd(filtered, has_aux=True)(value)
    return _bias_and_variance(mean - truth, gains, noise)


@partial(jax.jit, inline=True)
def _bias_and_variance(bias: Array, gains: Array, noise: Array) -> Array:
    variance = jnp.einsum("tklm,lmn,tkln->t", gains, noise, gains)
    return jnp.sum(jnp.square(bias), -1) + variance
