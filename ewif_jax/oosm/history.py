"""What the one-step methods share: the estimates of the last update times, and the late update."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from ewif_jax import checks
from ewif_jax.fast import slots
from ewif_jax.kernels import symmetric
from ewif_jax.kernels.trees import choose, copies
from ewif_jax.models import Model
from ewif_jax.oosm.equivalent import Equivalent
from ewif_jax.recursions.contract import verdict
from ewif_jax.recursions.covariance import CovarianceState, covariance_form
from ewif_jax.recursions.innovations import updated
from ewif_jax.types import Estimator, Gaussian, Info, Measurement, Status


class HistoryState(NamedTuple):
    """time (), mean (n,), cov (packed), used (): whether this time has taken a measurement, and
    past: time (L,), mean (L, n), cov (L, packed) at the last L update times, newest first."""

    time: Array
    mean: Array
    cov: Array
    used: Array
    past: CovarianceState


def one_step(model: Model, method: str, lag: int, equivalent: Equivalent) -> Estimator:
    r"""The one-step solution: a late measurement is one Kalman update of the present state.

    `equivalent` says what the late measurement is as one of the present state.

    At delay 0 it is the plain update, so there is one code path, and its cost does not depend on
    the delay.

    The estimate of a time is stored when the filter leaves that time, with everything it had taken
    until then, and is never rewritten: late arrivals between two moves all see the same history.
    Times without a used measurement are not stored. The prior at t0 is the first entry.
    """
    checks.require(isinstance(model, Model), "model", "a Model", type(model).__name__)
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
        seen, good = equivalent(model, params, state, start, measurement)
        mean, cov, info = updated(model, state.mean, state.cov, seen)
        status = jnp.where(good, info.status, jnp.int32(Status.REJECTED))
        return taken(state, mean, cov, measurement, known, info._replace(status=status))

    def estimate(params: Any, state: HistoryState) -> Gaussian:
        del params
        return Gaussian(state.mean, symmetric.unpack(symmetric.no_negative(state.cov)))

    return Estimator(init, predict, update, estimate, model=model)


def last_before(past: CovarianceState, time: Array) -> tuple[Array, CovarianceState]:
    """Whether there is an entry not newer than `time`, and the newest such (else the oldest)."""
    count = past.time.shape[0]
    newer = jnp.sum(past.time > time)
    here = jnp.arange(count) == jnp.minimum(newer, count - 1)
    return newer < count, jax.tree.map(lambda table: slots.picked(table, here), past)


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
