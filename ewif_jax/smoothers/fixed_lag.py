"""Smoothing a fixed lag behind the newest measurement, as an estimator for `run` and `step`."""

from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import Array

from ewif_jax import checks
from ewif_jax.fast.small import matmul
from ewif_jax.kernels import gaussian
from ewif_jax.kernels.trees import choose
from ewif_jax.models.linearise import predict_measurement, predict_state
from ewif_jax.models.model import Model
from ewif_jax.recipe import from_recipe
from ewif_jax.recursions.contract import verdict
from ewif_jax.types import Estimator, Gaussian, Info, Measurement


class LagState(NamedTuple):
    """time (), times (L + 1,): the newest first, mean (L + 1, n): the states at these times,
    cov ((L + 1) n, (L + 1) n): their joint covariance."""

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

    def init(params: Any, prior: Gaussian | None, t0: Any, key: Any = None) -> LagState:
        del params, key
        prior = checks.needs_prior(prior, "fixed_lag")
        checks.prior(prior)
        mean = jnp.asarray(prior.mean)
        t0 = jnp.asarray(t0, mean.dtype)
        cov = jnp.tile(jnp.asarray(prior.cov, mean.dtype), (slots, slots))
        return LagState(t0, jnp.full(slots, t0), jnp.tile(mean, (slots, 1)), cov)

    def predict(params: Any, state: LagState, time: Array) -> LagState:
        time = jnp.asarray(time, state.time.dtype)
        ahead = jnp.maximum(time, state.time)
        n = state.mean.shape[1]
        moved, F, Q = predict_state(model, params, state.mean[0], state.time, ahead)
        older = state.cov[: n * (slots - 1), : n * (slots - 1)]
        cross = matmul(F, older[:n])
        newest = matmul(cross[:, :n], F.T) + Q
        shifted = LagState(
            time,
            jnp.concatenate([time[None], state.times[:-1]]),
            jnp.concatenate([moved[None], state.mean[:-1]]),
            jnp.concatenate(
                [
                    jnp.concatenate([(newest + newest.T) / 2, cross], 1),
                    jnp.concatenate([cross.T, older], 1),
                ]
            ),
        )
        kept = choose(time > state.time, shifted, state)
        known = time >= state.time
        return kept._replace(
            time=time,
            mean=jnp.where(known, kept.mean, jnp.nan),
            cov=jnp.where(known, kept.cov, jnp.nan),
        )

    def update(params: Any, state: LagState, measurement: Measurement) -> tuple[LagState, Info]:
        mask = measurement.mask
        late, present = measurement.time < state.time, jnp.any(mask)
        n = state.mean.shape[1]
        predicted, H, R = predict_measurement(
            model, params, state.mean[0], measurement.sensor, measurement.time
        )
        checks.shape("measurement.value", measurement.value, (H.shape[0],))
        difference = model.residual(measurement.value, predicted, measurement.sensor)
        cross = matmul(H, state.cov[:n])
        seen = gaussian.innovate(difference, cross, matmul(cross[:, :n], H.T) + R, mask)
        gain = gaussian.gain(seen)
        half = state.cov - matmul(gain, seen.cross)
        correction = matmul(gain, gaussian.mask_cov(R, mask)) - matmul(half[:, :n], H.T)
        cov = half + matmul(correction, gain.T)
        cov = jnp.where(jnp.eye(len(cov), dtype=bool) & (cov < 0), 0, cov)  # rounding
        mean = state.mean + matmul(gain, seen.value[:, None]).reshape(slots, n)
        used = present & ~late
        info = Info(
            seen.value,
            seen.cov,
            jnp.where(used, gaussian.log_density(seen, mask), 0),
            state.time - measurement.time,
            verdict(late, present),
        )
        return choose(used, state._replace(mean=mean, cov=(cov + cov.T) / 2), state), info

    def estimate(params: Any, state: LagState) -> Gaussian:
        del params
        n = state.mean.shape[1]
        return Gaussian(state.mean[-1], state.cov[-n:, -n:])

    return Estimator(init, predict, update, estimate, model=model)
