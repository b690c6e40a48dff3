"""The exponentially weighted information filter of Shulami & Sigalov."""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
from jax import Array

from ewif_jax import checks
from ewif_jax.models.linearise import need_linear, need_reversible
from ewif_jax.models.model import Model, resolve
from ewif_jax.recipe import from_recipe
from ewif_jax.recursions import information as form
from ewif_jax.recursions.contract import verdict
from ewif_jax.recursions.information import InformationState
from ewif_jax.types import Estimator, Gaussian, Info, Measurement, Status


@from_recipe
def ewif(model: Model, tau: Any = None, *, weight: Callable[..., Array] | None = None) -> Estimator:
    r"""The least-squares estimate in which a measurement of age s counts exp(-s / tau).

    .. math::
        P_k^{-1} &= W_{m,k}^2 A_{m,k}' P_m^{-1} A_{m,k}
            + W_{d,k}^2 A_{d,k}' H_d' R_d^{-1} H_d A_{d,k} \quad (19) \\
        \hat x_k &= P_k \left( W_{m,k}^2 A_{m,k}' P_m^{-1} \hat x_m
            + W_{d,k}^2 A_{d,k}' H_d' R_d^{-1} (y_d - H_d c_{d,k}) \right) \quad (18)

    with :math:`W_{l,k} = e^{-(t_k - t_l)/2\tau}` (25): Shulami & Sigalov, Theorem 5, of which the
    filter (26)-(27), late measurements (36)-(37), prediction (34)-(35) and fixed-lag smoothing
    (section VI-A) are cases. There is no process noise and no history: a measurement of any
    validity time is one update, the order of arrival does not matter, and the state may be moved
    to any time, earlier ones too.

    Args:
        model: a linear `Model`; its F must allow t1 < t0, its process noise is ignored.
        tau: decay time in seconds, > 0, a number or a function of `params`.
        weight: instead, W(params, t_measurement, t_state) with W >= 0, W(t, t) = 1 and
            W(l, k) = W(l, m) W(m, k) (11a-c); W itself, not its square.

    `init` accepts `prior=None` (nothing is known about the state): `estimate` is then NaN until
    the measurements determine the state to rounding, and the log likelihood of the measurements up
    to there is 0. A prior counts as a measurement of the whole state at t0 and decays like one.
    After a gap so long that the weights underflow the estimate is NaN again, until new
    measurements determine the state.

    Reduces to: `kalman` without process noise as tau grows; `fading` with inflation exp(dt / tau)
        and Q = 0; least squares over all the data (8)-(9).

    Deviations: known inputs enter both the transport of the old estimate and the residual of a
        late measurement (the paper sets them to zero after (10)). The covariance is the paper's P,
        which is not the covariance of the error under its model (3).

    Raises:
        ValueError: both or neither of `tau` and `weight`; tau <= 0; a model that is not linear.
    """
    need_linear(model, "ewif")
    need_reversible(model, "ewif")
    one = (tau is None) != (weight is None)
    checks.require(one, "tau", "one of `tau` and `weight`", (tau, weight))
    if tau is not None and not callable(tau):
        checks.positive("tau", tau)

    def squared(params: Any, measured: Array, at: Array) -> Array:
        if weight is not None:
            return jnp.square(weight(params, measured, at))
        decay = checks.positive("tau", resolve(tau, params))
        return jnp.exp((measured - at) / decay)

    def init(params: Any, prior: Gaussian | None, t0: Any, key: Any = None) -> InformationState:
        del key
        if tau is not None:
            checks.positive("tau", resolve(tau, params))
        return form.start(model, params, prior, t0)

    def predict(params: Any, state: InformationState, time: Array) -> InformationState:
        time = jnp.asarray(time, state.time.dtype)
        w2 = jnp.asarray(squared(params, state.time, time), state.mean.dtype)
        return form.transport(model, params, state, time, w2)

    def update(
        params: Any, state: InformationState, measurement: Measurement
    ) -> tuple[InformationState, Info]:
        present = jnp.any(measurement.mask)
        w2 = jnp.asarray(squared(params, measurement.time, state.time), state.mean.dtype)
        updated, info = form.absorb(model, params, state, measurement, w2)
        late = measurement.time < state.time
        status = verdict(late, present, Status.LATE_USED)
        return updated, info._replace(status=status)

    def estimate(params: Any, state: InformationState) -> Gaussian:
        del params
        return form.settled(state)

    return Estimator(init, predict, update, estimate, model=model)
