"""Smoothing a fixed lag behind the newest measurement, as an estimator for `run` and `step`."""

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from ewif_jax import checks
from ewif_jax.fast.small import matmul
from ewif_jax.kernels import symmetric
from ewif_jax.kernels.trees import choose
from ewif_jax.models.linearise import predict_state
from ewif_jax.models.model import Model
from ewif_jax.recipe import from_recipe
from ewif_jax.recursions.contract import Recursion, estimator_from
from ewif_jax.recursions.covariance import measure
from ewif_jax.types import Estimator, Gaussian, Info, Measurement, Params, RandomKey


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

    def start(params: Params, prior: Gaussian, t0: Array, key: RandomKey) -> LagState:
        del params, key
        cov = symmetric.pack(jnp.tile(prior.cov, (slots, slots)))
        return LagState(t0, jnp.full(slots, t0), jnp.tile(prior.mean, (slots, 1)), cov)

    def move(params: Params, state: LagState, time: Array) -> LagState:
        n = state.mean.shape[1]
        moved, F, Q = predict_state(model, params, state.mean[0], state.time, time)
        # The oldest state leaves the joint covariance and the new one enters it in front: F applies
        # to the newest block only, so its covariance with the rest is F times the first row of
        # blocks.
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
        params: Params, state: LagState, measurement: Measurement
    ) -> tuple[LagState, Info]:
        # The sensor sees the newest state alone; the others move through what they have in common
        # with it, which is the joint covariance.
        flat, older = state.mean.ravel(), state.mean[1:].size
        mean, cov, info = measure(model, params, flat, state.cov, measurement, older)
        return state._replace(mean=mean.reshape(state.mean.shape), cov=cov), info

    def estimate(params: Params, state: LagState) -> Gaussian:
        del params
        n = state.mean.shape[1]
        cov = symmetric.unpack(symmetric.no_negative(state.cov))
        return Gaussian(state.mean[-1], cov[-n:, -n:])

    return estimator_from(
        Recursion("fixed_lag", start, move, measure_newest, estimate, keeps=True, model=model)
    )
