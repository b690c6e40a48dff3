"""Anderson's Kalman filter with exponential data weighting."""

from collections.abc import Callable

import jax.numpy as jnp
from jax import Array

from ewif_jax import checks
from ewif_jax.models.linearise import need_linear
from ewif_jax.models.model import Model, resolve
from ewif_jax.models.steps import count_steps
from ewif_jax.recipe import from_recipe
from ewif_jax.recursions.covariance import covariance_form
from ewif_jax.types import Estimator, Parameter, Params


@from_recipe
def fading(
    model: Model, fading: Parameter = None, *, inflation: Callable[..., Array] | None = None
) -> Estimator:
    r"""The Kalman filter that weights the data of step k by :math:`\alpha^{2k}`.

    .. math::
        \hat\Pi(k) &= \alpha^2 F \Pi(k-1) F' + Q \quad (5\text{-}14) \\
        K &= \hat\Pi H' (H \hat\Pi H' + R)^{-1} \quad (5\text{-}13) \\
        \Pi(k) &= (I - K H) \hat\Pi (I - K H)' + K R K' \quad (5\text{-}15)

    Anderson (1973), section 5, in the usual notation z = H x.

    Args:
        model: a linear `Model`.
        fading: Anderson's alpha >= 1, a number or a function of `params`: for every step of a
            discrete model, alpha^(2k) over k of them; else for every move over a nonempty
            interval, whatever its length.
        inflation: instead, the factor alpha^2 of an interval, a function (params, t0, t1) -> ();
            exp((t1 - t0) / tau) makes this filter the EWIF when Q = 0.

    Reduces to: `kalman` for alpha = 1; `ewif` with a Gaussian prior for Q = 0 and inflation
        exp((t1 - t0) / tau).

    Deviations: over one interval the inflation is at most 1 / eps of the dtype (a gap of 16 tau in
        float32, 36 tau in float64), and the largest variance at most the square root of the
        largest float: a covariance cannot hold "nothing is known" and R at once. After a longer gap
        the old estimate therefore fades while new data arrive; `ewif` forgets it at once. The
        variances are inflated by up to 8 n eps more, which rounding would otherwise take away.

    Raises:
        ValueError: both or neither of `fading` and `inflation`; fading < 1.
    """
    need_linear(model, "fading")
    both = (fading is None) == (inflation is None)
    checks.require(not both, "fading", "one of `fading` and `inflation`", (fading, inflation))
    if inflation is not None:
        return covariance_form(model, "fading", inflation)
    if not callable(fading):
        checks.at_least("fading", fading, 1.0)

    def per_step(params: Params, t0: Array, t1: Array) -> Array:
        alpha = checks.at_least("fading", resolve(fading, params), 1.0)
        checks.shape("fading", alpha, ())
        if model.steps is None:
            return jnp.where(t1 > t0, jnp.square(alpha), 1)
        k, _ = count_steps(model.steps, t0, t1)
        # Only forwards: against time the factor would take back what was forgotten.
        return jnp.where(k > 0, alpha, 1) ** (2 * k)

    return covariance_form(model, "fading", per_step)
