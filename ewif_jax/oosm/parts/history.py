"""What the one-step methods share: the estimates of the last update times, and the late update."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from ewif_jax import checks
from ewif_jax.fast import slots
from ewif_jax.kernels.trees import copies
from ewif_jax.models import Model
from ewif_jax.oosm.parts.equivalent import Equivalent
from ewif_jax.recursions.contract import Recursion, estimator_from
from ewif_jax.recursions.covariance import CovarianceState, covariance_recursion
from ewif_jax.recursions.innovations import updated
from ewif_jax.types import Estimator, Gaussian, Info, Measurement, Params, RandomKey, Status


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
    in_sequence = covariance_recursion(model, method)

    def start(params: Params, prior: Gaussian, t0: Array, key: RandomKey) -> HistoryState:
        first = in_sequence.init(params, prior, t0, key)
        return HistoryState(
            first.time, first.mean, first.cov, jnp.asarray(False), copies(first, lag)
        )

    def move(params: Params, state: HistoryState, time: Array) -> HistoryState:
        now = CovarianceState(state.time, state.mean, state.cov)
        moved = in_sequence.move(params, now, time)
        left = time > state.time
        # Only what the filter learnt something from is worth a slot: a time of prediction alone is
        # between its neighbours anyway, and would shorten the reach.
        push = left & state.used
        past = jax.tree.map(lambda new, old: slots.pushed(new, old, push), now, state.past)
        return HistoryState(time, moved.mean, moved.cov, state.used & ~left, past)

    def is_after_oldest(params: Params, state: HistoryState, time: Array) -> Array:
        del params
        return time >= state.past.time[-1]

    def measure(
        params: Params, state: HistoryState, measurement: Measurement
    ) -> tuple[HistoryState, Info]:
        _, before = last_before(state.past, measurement.time)
        seen, usable = equivalent(model, params, state, before, measurement)
        mean, cov, info = updated(model, state.mean, state.cov, seen)
        status = jnp.where(usable, info.status, jnp.int32(Status.REJECTED))
        used = state.used | (jnp.any(measurement.mask) & (status == Status.USED))
        return state._replace(mean=mean, cov=cov, used=used), info._replace(status=status)

    # A masked measurement is one of H = 0, which leaves every number of the state.
    return estimator_from(
        Recursion(
            method,
            start,
            move,
            measure,
            in_sequence.estimate,
            is_after_oldest,
            keeps=True,
            model=model,
        )
    )


def last_before(past: CovarianceState, time: Array) -> tuple[Array, CovarianceState]:
    """Whether there is an entry not newer than `time`, and the newest such (else the oldest)."""
    count = past.time.shape[0]
    newer = jnp.sum(past.time > time)
    here = jnp.arange(count) == jnp.minimum(newer, count - 1)
    return newer < count, jax.tree.map(lambda table: slots.picked(table, here), past)
