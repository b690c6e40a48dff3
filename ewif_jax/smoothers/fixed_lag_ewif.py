"""The EWIF that reports a fixed time behind its own."""

from collections.abc import Callable
from typing import Any

from jax import Array

from ewif_jax import checks
from ewif_jax.estimators.ewif import ewif
from ewif_jax.models.model import Model, resolve
from ewif_jax.models.steps import check_interval
from ewif_jax.recipe import from_recipe
from ewif_jax.recursions.information import InformationState
from ewif_jax.types import Estimator, Gaussian, Numbers, Parameter, Params, RandomKey


@from_recipe
def fixed_lag_ewif(
    model: Model,
    tau: Parameter = None,
    *,
    lag: Parameter,
    weight: Callable[..., Array] | None = None,
) -> Estimator:
    r"""The `ewif` that reports `lag` seconds behind its own time.

    .. math::
        \hat x_{k} = A_{k,m} \hat x_m, \quad P_k = W_{m,k}^{-2} A_{k,m} P_m A_{k,m}'
        \quad (34), (35), \quad t_k = t_m - \text{lag}

    Shulami & Sigalov, Theorem 5 and section VI-A: there is no process noise, so the smoothed state
    is the newest one moved back, inputs included. Since W of a newer measurement is above 1, this
    is not the symmetrically weighted smoother: that is `two_sided_ewif`.

    Args:
        model, tau, weight: as in `ewif`.
        lag: seconds >= 0, a number or a function of `params`.

    Reduces to: `ewif` for lag 0; `batch_wls` at the reported time with the weight of `ewif`.

    Raises:
        ValueError: as `ewif`; lag < 0, or not whole steps of a discrete model.
    """
    filtered = ewif(model, tau, weight=weight)
    if not callable(lag):
        _check_lag(model, lag)

    def init(
        params: Params, prior: Gaussian | None, t0: Numbers, key: RandomKey = None
    ) -> InformationState:
        _check_lag(model, resolve(lag, params))
        return filtered.init(params, prior, t0, key)

    def estimate(params: Params, state: InformationState) -> Gaussian:
        behind = _check_lag(model, resolve(lag, params))
        return filtered.estimate(params, filtered.predict(params, state, state.time - behind))

    return Estimator(init, filtered.predict, filtered.update, estimate, model=filtered.model)


def _check_lag(model: Model, lag: Parameter) -> Any:
    """Refuses a known lag that is negative or no interval of the model; returns it."""
    checks.shape("lag", lag, ())
    check_interval(model.steps, "lag", checks.at_least("lag", lag, 0.0))
    return lag
