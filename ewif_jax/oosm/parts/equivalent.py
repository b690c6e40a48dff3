"""A late measurement as one of the present state: which H and R it has, and what it differs by."""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
from jax import Array, lax

from ewif_jax import checks
from ewif_jax.fast.small import matmul, matvec
from ewif_jax.fast.sparse import dense
from ewif_jax.kernels import cholesky, symmetric
from ewif_jax.models import Model, predict_measurement, predict_state
from ewif_jax.models.angles import state_difference
from ewif_jax.models.linearise import predicted_value
from ewif_jax.recursions.covariance import CovarianceState
from ewif_jax.recursions.innovations import Compared
from ewif_jax.types import Measurement, Params, State

Equivalent = Callable[
    [Model, Any, Any, CovarianceState, Measurement], tuple[Compared, Array | bool]
]
"""(model, params, state, start, measurement) -> the measurement as one of the state of now, and
whether it can be used, () bool; `start` is the last stored estimate before it."""


def noise_estimated(
    model: Model, params: Params, state: State, start: CovarianceState, measurement: Measurement
) -> tuple[Compared, Array | bool]:
    """The equivalent measurement with the process noise estimated, in the form that fits the model.

    Both are the same numbers for a linear model. Printed takes half the time, but a fast stable
    mode comes back as exp(+t), and through a singular F nothing does. Tied to the start it is right
    for any linear motion.
    """
    if model.linear is None or model.returns_well:
        return moved_back(model, params, state, start, measurement, noise_estimated=True)
    return tied_to_start(model, params, state, start, measurement)


def tied_to_start(
    model: Model, params: Params, state: State, start: CovarianceState, measurement: Measurement
) -> tuple[Compared, Array | bool]:
    r"""The equivalent measurement of a linear model, without motion back in time.

    With :math:`x_d, P_d` predicted from `start` to the measurement's time :math:`t_d`, F and Q from
    there to now, :math:`M = F P_d F' + Q` and :math:`G = P_d F' M^{-1}`,

    .. math::
        \hat z = H (x_d + G (\hat x - F x_d)), \quad \tilde H = H G, \quad
        \tilde R = R + H \left( (I - G F) P_d (I - G F)' + G Q G' \right) H'

    Where F has an inverse A, :math:`G = A (I - Q M^{-1})` and the bracket is
    :math:`A (Q - Q M^{-1} Q) A'`: the printed form. Both terms of the bracket are positive
    semidefinite, and rounding errors of G enter them squared.
    """
    now = state.time
    time = jnp.clip(measurement.time, start.time, now)
    there, F, Q = predict_state(model, params, start.mean, start.time, time)
    cov = symmetric.congruence(F, start.cov) + symmetric.pack(Q)
    predicted, F, Q = predict_state(model, params, there, time, now)
    M = symmetric.congruence(F, cov) + symmetric.pack(Q)
    value, H, R = predict_measurement(model, params, there, measurement.sensor, measurement.time)
    checks.shape("measurement.value", measurement.value, (H.shape[0],))
    weights, _ = symmetric.regress(M, matmul(symmetric.rows(H, cov), F.T))
    value = value + matvec(weights, state.mean - predicted)
    left = dense(H) - matmul(weights, F)
    # H cov(x_d | x_k) H' in Joseph's form, with G inside as H G: rounding of the weights enters
    # squared.
    spread = matmul(symmetric.rows(left, cov), left.T) + matmul(matmul(weights, Q), weights.T)
    # A plain update in sequence, to the last digit: there M adds nothing but its rounding.
    late = time < now
    seen_now = predicted_value(model, params, H, state.mean, measurement.sensor, measurement.time)
    value = jnp.where(late, value, seen_now)
    difference = model.residual(measurement.value, value, measurement.sensor)
    H, R = jnp.where(late, weights, dense(H)), jnp.where(late, R + spread, R)
    return Compared(difference, H, R, measurement.mask), True


def moved_back(
    model: Model,
    params: Params,
    state: State,
    start: CovarianceState,
    measurement: Measurement,
    *,
    noise_estimated: bool,
) -> tuple[Compared, Array | bool]:
    r"""The equivalent measurement by motion back in time, as it is printed.

    With :math:`M = P(k|k-l)` predicted from `start`, Q = Q(k, d), A = F(d, k),

    .. math::
        \hat z = h(A (\hat x - \hat v)), \quad \hat v = Q M^{-1} (\hat x - \hat x(k|k-l)) \\
        \tilde H = H A (I - Q M^{-1}), \quad \tilde R = R + H A\, (Q - Q M^{-1} Q) A' H'

    which is (71)-(86) of Pornsarayouth & Yamakita without the inverse of the singular R* of (84).
    With `noise_estimated` False v is taken as zero and
    :math:`\tilde R = R + H A\, (Q - Q M^{-1} P M^{-1} Q) A' H'`.

    Not usable where A is so large that A Q A' is not a number.
    """
    dtype, good = state.mean.dtype, jnp.asarray(True)
    at = jnp.clip(measurement.time, start.time, state.time)
    predicted, F, Q_all = predict_state(model, params, start.mean, start.time, state.time)
    M = symmetric.congruence(F, start.cov) + symmetric.pack(Q_all)
    Q = jnp.asarray(model.process_cov(params, at, state.time), dtype)
    moved, origin = state_difference(model, state.mean, predicted), state.mean
    if noise_estimated and model.linear is None:
        origin = origin - matvec(Q, cholesky.solved(symmetric.unpack(M), moved))
    if not model.returns_well:
        # The derivative of a motion that overflows is not a number even where it is not selected,
        # so the time is replaced, not the matrix.
        good = lax.stop_gradient(
            _has_way_back(dense(predict_state(model, params, origin, state.time, at)[1]))
        )
        at = jnp.where(good, at, state.time)
    there, back, _ = predict_state(model, params, origin, state.time, at)
    value, H, R = predict_measurement(model, params, there, measurement.sensor, measurement.time)
    checks.shape("measurement.value", measurement.value, (H.shape[0],))
    seen = matmul(H, back)
    noisy = matmul(seen, Q)
    weights, explained = symmetric.regress(M, noisy)  # Q is part of M: what M has not, Q has not
    if noise_estimated and model.linear is not None:
        value = value - matvec(weights, moved)
    if not noise_estimated:
        explained = matmul(symmetric.rows(weights, state.cov), weights.T)
    difference = model.residual(measurement.value, value, measurement.sensor)
    R = R + matmul(noisy, seen.T) - explained
    return Compared(difference, seen - weights, R, measurement.mask & good), good


def _has_way_back(back: Array) -> Array:
    """Whether numbers come back through this matrix: A Q A' has to be finite."""
    return jnp.max(jnp.abs(back)) < jnp.finfo(back.dtype).max ** 0.25
