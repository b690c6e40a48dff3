"""The extended Kalman filter."""

from ewif_jax import checks
from ewif_jax.models.model import Model
from ewif_jax.recipe import from_recipe
from ewif_jax.recursions.covariance import covariance_form
from ewif_jax.types import Estimator


@from_recipe
def extended(model: Model) -> Estimator:
    r"""The Kalman filter of the model linearised at the current mean.

    .. math::
        \hat x^- = f(\hat x), \quad P^- = F P F' + Q, \quad F = \partial f / \partial x |_{\hat x},
        \quad H = \partial h / \partial x |_{\hat x^-}

    with automatic Jacobians; innovations go through `model.residual`, so angles wrap. Late
    measurements, masks and singular matrices as in `kalman`.

    Reduces to: `kalman` on a linear model.

    Raises:
        ValueError: `init` with `prior=None`.
    """
    checks.require(isinstance(model, Model), "model", "a Model", type(model).__name__)
    return covariance_form(model, "extended")
