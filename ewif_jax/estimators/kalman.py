"""The Kalman filter in covariance form."""

from ewif_jax.models.linearise import need_linear
from ewif_jax.models.model import Model
from ewif_jax.recipe import from_recipe
from ewif_jax.recursions.covariance import covariance_form
from ewif_jax.types import Estimator


@from_recipe
def kalman(model: Model) -> Estimator:
    r"""The Kalman filter of a linear model, Joseph-stabilised.

    .. math::
        \hat x^- &= F \hat x + b, \quad P^- = F P F' + Q \quad (28), (31) \\
        \hat x &= \hat x^- + K (z - H \hat x^-), \quad K = P^- H' (H P^- H' + R)^{-1} \quad (30) \\
        P &= (I - K H) P^- (I - K H)' + K R K'

    after Shulami & Sigalov, section V-B. Q, P and R may be singular or zero; a component that is
    measured exactly (R zero in its direction) and known exactly already tells nothing, whatever its
    value: it moves nothing, and counts 0 in the log likelihood. A late measurement is not used
    (`TOO_LATE`): lift the filter with `replay`, or choose a method of `oosm`. Asked for a time
    before its own it predicts NaN.

    Args:
        model: a linear `Model`; its parameters may be functions of `params`.

    Raises:
        ValueError: the model is not linear; `init` with `prior=None`.
    """
    need_linear(model, "kalman")
    return covariance_form(model, "kalman")
