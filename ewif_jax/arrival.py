"""The one body of an arrival, which `run`, `step` and `run_batch` share."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from ewif_jax.models.steps import whole_steps
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
    what is reported is its prediction. What lies between two steps of a discrete model is
    `REJECTED`, and moves nothing.
    """
    measurement = cast(measurement, state.time.dtype)
    steps = None if estimator.model is None else estimator.model.steps
    if steps is None:
        return _arrived(estimator, params, state, measurement, to)
    clock = state.time if to is None else jnp.maximum(state.time, to)
    in_step = whole_steps(steps, state.time, clock)
    whole = in_step & whole_steps(steps, clock, measurement.time)
    # Nothing is ever asked of the model that it cannot answer: its NaN would reach derivatives.
    clock = jnp.where(in_step, clock, state.time)
    here = jnp.where(whole, measurement.time, clock)
    usable = measurement._replace(time=here, mask=measurement.mask & whole)
    arrival = _arrived(estimator, params, state, usable, None if to is None else clock)
    refused = jnp.any(measurement.mask) & ~whole
    info = arrival.info._replace(
        delay=jnp.where(refused, clock - measurement.time, arrival.info.delay),
        status=jnp.where(refused, jnp.int32(Status.REJECTED), arrival.info.status),
    )
    return arrival._replace(info=info)


def _arrived(
    estimator: Estimator, params: Any, state: Any, measurement: Measurement, to: Array | None
) -> Arrival:
    target = jnp.maximum(state.time, measurement.time if to is None else to)
    moved = estimator.predict(params, state, target)
    updated, info = estimator.update(params, moved, measurement)
    if to is not None:
        return Arrival(updated, updated, info)
    present = jnp.any(measurement.mask)
    kept = jax.tree.map(lambda new, old: jnp.where(present, new, old), updated, state)
    return Arrival(kept, updated, info)


def initial(
    estimator: Estimator, params: Any, prior: Gaussian | None, t0: Any, dtype: Any, key: Any
) -> Any:
    """The estimator's first state, with prior (left known where it is known) and t0 in `dtype`."""
    return estimator.init(params, prior_in(prior, dtype), jnp.asarray(t0, dtype), key)


def prior_in(prior: Gaussian | None, dtype: Any) -> Gaussian | None:
    """The prior in `dtype`, its value known as before."""
    return None if prior is None else Gaussian(*(in_dtype(x, dtype) for x in prior))
