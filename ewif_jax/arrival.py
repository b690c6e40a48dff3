"""The one body of an arrival, which `run`, `step` and `run_batch` share."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from ewif_jax.clocks import slack
from ewif_jax.streams import cast, in_dtype
from ewif_jax.types import Estimator, Gaussian, Info, Measurement, Status


class Arrival(NamedTuple):
    """What one arrival does: the state that goes on, the state to report from, and diagnostics."""

    kept: Any
    reported: Any
    info: Info


def arrive(
    estimator: Estimator, params: Any, state: Any, measurement: Measurement, to: Array | None = None
) -> Arrival:
    """Moves `state` to the measurement (or to the clock time `to`) and updates it.

    With nothing in the measurement (mask all False) and no clock the filter stays where it is;
    what is reported is its prediction.
    """
    measurement = cast(measurement, state.time.dtype)
    target = jnp.maximum(state.time, measurement.time if to is None else to)
    moved = estimator.predict(params, state, target)
    if to is not None:
        return _by_the_clock(estimator, params, state, moved, target, measurement)
    updated, info = estimator.update(params, moved, measurement)
    present = jnp.any(measurement.mask)
    kept = jax.tree.map(lambda new, old: jnp.where(present, new, old), updated, state)
    return Arrival(kept, updated, info)


def _by_the_clock(
    estimator: Estimator, params: Any, state: Any, moved: Any, clock: Array, given: Measurement
) -> Arrival:
    """What arrives when the filter's clock shows `clock`. A stamp ahead of it (more than rounding)
    is `REJECTED`, and the filter stays where it was; what is reported is its prediction."""
    limit = clock + slack(jnp, given.time, clock)
    ahead = jnp.any(given.mask) & (given.time > limit)
    usable = given._replace(time=jnp.minimum(given.time, clock), mask=given.mask & ~ahead)
    updated, info = estimator.update(params, moved, usable)
    kept = jax.tree.map(lambda new, old: jnp.where(ahead, old, new), updated, state)
    status = jnp.where(ahead, jnp.int32(Status.REJECTED), info.status)
    delay = jnp.where(ahead, clock - given.time, info.delay)
    return Arrival(kept, updated, info._replace(status=status, delay=delay))


def initial(
    estimator: Estimator, params: Any, prior: Gaussian | None, t0: Any, dtype: Any, key: Any
) -> Any:
    """The estimator's first state, with prior (left known where it is known) and t0 in `dtype`."""
    return estimator.init(params, prior_in(prior, dtype), jnp.asarray(t0, dtype), key)


def prior_in(prior: Gaussian | None, dtype: Any) -> Gaussian | None:
    """The prior in `dtype`, its value known as before."""
    return None if prior is None else Gaussian(*(in_dtype(x, dtype) for x in prior))
