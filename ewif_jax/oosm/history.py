"""What the one-step methods share: the estimates of the last update times, and the late update."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from ewif_jax import checks
from ewif_jax.fast import slots
from ewif_jax.fast.small import matmul, matvec
from ewif_jax.kernels import cholesky, symmetric
from ewif_jax.kernels.trees import choose, copies
from ewif_jax.models import Model, patterns, predict_measurement, predict_state
from ewif_jax.models.linearise import need_reversible
from ewif_jax.recursions.contract import verdict
from ewif_jax.recursions.covariance import CovarianceState, covariance_form
from ewif_jax.recursions.innovations import Compared, updated
from ewif_jax.types import Estimator, Gaussian, Info, Measurement, Status


class HistoryState(NamedTuple):
    """time (), mean (n,), cov (packed), used (): whether this time has taken a measurement, and
    past: time (L,), mean (L, n), cov (L, packed) at the last L update times, newest first."""

    time: Array
    mean: Array
    cov: Array
    used: Array
    past: CovarianceState


def one_step(model: Model, method: str, lag: int, noise_estimated: bool) -> Estimator:
    r"""The one-step solution: a late measurement is one Kalman update of the present state.

    With :math:`t_{k-l}` the last stored time before :math:`t_d`,
    :math:`M = P(k|k-l)` and Q = Q(k, d), A = F(d, k),

    .. math::
        \hat z = h(A (\hat x - \hat v)), \quad \hat v = Q M^{-1} (\hat x - \hat x(k|k-l)) \\
        \tilde H = H A (I - Q M^{-1}), \quad \tilde R = R + H A\, (Q - Q M^{-1} Q) A' H'

    which is (71)-(86) of Pornsarayouth & Yamakita without the inverse of the singular R* of (84).
    With `noise_estimated` False v is taken as zero and
    :math:`\tilde R = R + H A\, (Q - Q M^{-1} P M^{-1} Q) A' H'`.

    At delay 0 it is the plain update, so there is one code path, and its cost does not depend on
    the delay.

    The estimate of a time is stored when the filter leaves that time, with everything it had taken
    until then, and is never rewritten: late arrivals between two moves all see the same history.
    Times without a used measurement are not stored. The prior at t0 is the first entry.
    """
    checks.require(isinstance(model, Model), "model", "a Model", type(model).__name__)
    need_reversible(model, method)
    lag = checks.whole("lag", lag, 1)
    form = covariance_form(model, method)

    def init(params: Any, prior: Gaussian | None, t0: Any, key: Any = None) -> HistoryState:
        first = form.init(params, prior, t0, key)
        past = copies(first, lag)
        return HistoryState(first.time, first.mean, first.cov, jnp.asarray(False), past)

    def predict(params: Any, state: HistoryState, time: Array) -> HistoryState:
        now = CovarianceState(state.time, state.mean, state.cov)
        moved = form.predict(params, now, time)
        left = moved.time > state.time
        push = left & state.used
        past = jax.tree.map(lambda new, old: slots.pushed(new, old, push), now, state.past)
        return HistoryState(moved.time, moved.mean, moved.cov, state.used & ~left, past)

    def update(
        params: Any, state: HistoryState, measurement: Measurement
    ) -> tuple[HistoryState, Info]:
        known, start = last_before(state.past, measurement.time)
        mean, cov, info = late_update(model, params, state, start, measurement, noise_estimated)
        return taken(state, mean, cov, measurement, known, info)

    def estimate(params: Any, state: HistoryState) -> Gaussian:
        del params
        return Gaussian(state.mean, symmetric.unpack(state.cov))

    return Estimator(init, predict, update, estimate, model=model)


def last_before(past: CovarianceState, time: Array) -> tuple[Array, CovarianceState]:
    """Whether there is an entry not newer than `time`, and the newest such (else the oldest)."""
    count = past.time.shape[0]
    newer = jnp.sum(past.time > time)
    here = jnp.arange(count) == jnp.minimum(newer, count - 1)
    return newer < count, jax.tree.map(lambda table: slots.picked(table, here), past)


def late_update(
    model: Model,
    params: Any,
    state: HistoryState,
    start: CovarianceState,
    measurement: Measurement,
    noise_estimated: bool,
) -> tuple[Array, Array, Info]:
    """Mean and packed covariance of now after a measurement of a time between `start` and now."""
    dtype = state.mean.dtype
    at = jnp.clip(measurement.time, start.time, state.time)
    predicted, F, Q_all = predict_state(model, params, start.mean, start.time, state.time)
    F_where, H_where = patterns(model)
    M = symmetric.congruence(F, start.cov, F_where) + symmetric.pack(Q_all)
    Q = jnp.asarray(model.process_cov(params, at, state.time), dtype)
    moved, origin = state.mean - predicted, state.mean
    if noise_estimated and model.linear is None:
        origin = origin - matvec(Q, cholesky.solved(symmetric.unpack(M), moved))
    there, back, _ = predict_state(model, params, origin, state.time, at)
    value, H, R = predict_measurement(model, params, there, measurement.sensor, measurement.time)
    checks.shape("measurement.value", measurement.value, (H.shape[0],))
    seen = matmul(H, back, H_where)
    noisy = matmul(seen, Q)
    weights, explained = symmetric.regress(M, noisy)  # Q is part of M: what M has not, Q has not
    if noise_estimated and model.linear is not None:
        value = value - matvec(weights, moved)
    if not noise_estimated:
        explained = matmul(symmetric.rows(weights, state.cov), weights.T)
    H_now, R_now = seen - weights, R + matmul(noisy, seen.T) - explained
    difference = model.residual(measurement.value, value, measurement.sensor)
    seen = Compared(difference, H_now, R_now, measurement.mask)
    return updated(model, state.mean, state.cov, seen)


def taken(
    state: HistoryState,
    mean: Array,
    cov: Array,
    measurement: Measurement,
    known: Array,
    info: Info,
) -> tuple[HistoryState, Info]:
    """The state with this mean and covariance if the measurement is `known` to be young enough,
    present, and not refused by `info`, which gets its delay and status."""
    late, present = measurement.time < state.time, jnp.any(measurement.mask)
    good = info.status == Status.USED
    new = state._replace(mean=mean, cov=cov, used=jnp.asarray(True))
    status = verdict(late, present, Status.LATE_USED, good)
    info = info._replace(delay=state.time - measurement.time, status=status)
    return choose(known & present & good, new, state), too_late(info, ~known)


def too_late(info: Info, refused: Array) -> Info:
    """`info` of a measurement that was not used where `refused`: TOO_LATE, log likelihood 0."""
    refused = refused & (info.status != Status.MASKED)
    return info._replace(
        log_likelihood=jnp.where(refused, 0, info.log_likelihood),
        status=jnp.where(refused, jnp.int32(Status.TOO_LATE), info.status),
    )
