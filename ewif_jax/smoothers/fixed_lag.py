"""Smoothing a fixed lag behind the newest measurement, as estimators for `run` and `step`."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import Array

from ewif_jax import checks
from ewif_jax.estimators.ewif import ewif
from ewif_jax.fast.small import matmul
from ewif_jax.kernels import symmetric
from ewif_jax.kernels.trees import choose
from ewif_jax.models.linearise import predict_state
from ewif_jax.models.model import Model, resolve
from ewif_jax.recipe import from_recipe
from ewif_jax.recursions.contract import Recursion, estimator_from
from ewif_jax.recursions.covariance import measure
from ewif_jax.recursions.information import InformationState
from ewif_jax.types import Estimator, Gaussian, Info, Measurement


class LagState(NamedTuple):
    """time (), times (L + 1,): the newest first, mean (L + 1, n): the states at these times,
    cov (packed): their joint covariance."""

    time: Array
    times: Array
    mean: Array
    cov: Array


@from_recipe
def fixed_lag(model: Model, lag: int) -> Estimator:
    r"""The Kalman estimate of the state `lag` measurement times ago.

    The filter carries the joint Gaussian of :math:`x_k, x_{k-1}, \dots, x_{k-L}` (state
    augmentation; Anderson & Moore, *Optimal Filtering*, 1979, section 7.3); a measurement of x_k
    updates them all, and what is reported is x_{k-L}. Where the model is not linear its Jacobians
    at the newest mean take the place of F and H.

    Args:
        model: any `Model`.
        lag: L >= 1, how many distinct times back. The time that a report refers to is
            `state.times[-1]`; until L times have passed it is t0.

    In `run` keep the default report times: reporting at a later one counts as one more time.
    A measurement older than the newest time is `TOO_LATE`.

    Returns:
        An `Estimator`; `estimate` gives mean (n,) and cov (n, n) of x_{k-L}. It needs a prior.

    Raises:
        ValueError: lag < 1; prior=None.

    Reduces to: `rts` at x_{k-L} of the measurements up to k.
    """
    slots = checks.whole("lag", lag, 1) + 1

    def start(params: Any, prior: Gaussian, t0: Array, key: Any) -> LagState:
        del params, key
        cov = symmetric.pack(jnp.tile(prior.cov, (slots, slots)))
        return LagState(t0, jnp.full(slots, t0), jnp.tile(prior.mean, (slots, 1)), cov)

    def move(params: Any, state: LagState, time: Array) -> LagState:
        n = state.mean.shape[1]
        moved, F, Q = predict_state(model, params, state.mean[0], state.time, time)
        older = symmetric.unpack(state.cov)[:-n, :-n]
        cross = matmul(F, older[:n])
        newest = matmul(cross[:, :n], F.T) + Q
        upper = jnp.concatenate([newest, cross], 1)
        lower = jnp.concatenate([cross.T, older], 1)
        shifted = LagState(
            time,
            jnp.concatenate([time[None], state.times[:-1]]),
            jnp.concatenate([moved[None], state.mean[:-1]]),
            symmetric.pack(jnp.concatenate([upper, lower])),
        )
        return choose(time > state.time, shifted, state)

    def measure_newest(
        params: Any, state: LagState, measurement: Measurement
    ) -> tuple[LagState, Info]:
        flat, older = state.mean.ravel(), state.mean[1:].size
        mean, cov, info = measure(model, params, flat, state.cov, measurement, older)
        return state._replace(mean=mean.reshape(state.mean.shape), cov=cov), info

    def estimate(params: Any, state: LagState) -> Gaussian:
        del params
        n = state.mean.shape[1]
        cov = symmetric.unpack(symmetric.no_negative(state.cov))
        return Gaussian(state.mean[-1], cov[-n:, -n:])

    return estimator_from(
        Recursion("fixed_lag", start, move, measure_newest, estimate, keeps=True, model=model)
    )


@from_recipe
def fixed_lag_ewif(
    model: Model, tau: Any = None, *, lag: Any, weight: Callable[..., Array] | None = None
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
        ValueError: as `ewif`; lag < 0.
    """
    filtered = ewif(model, tau, weight=weight)
    if not callable(lag):
        checks.at_least("lag", lag, 0.0)

    def estimate(params: Any, state: InformationState) -> Gaussian:
        behind = checks.at_least("lag", resolve(lag, params), 0.0)
        return filtered.estimate(params, filtered.predict(params, state, state.time - behind))

    return Estimator(*filtered[:3], estimate, model=model)
