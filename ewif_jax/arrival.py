"""The one body of an arrival, which `run`, `step`, `run_batch` and `run_parallel` share."""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from ewif_jax.clocks import slack
from ewif_jax.kernels.trees import choose
from ewif_jax.models.components import existing
from ewif_jax.models.steps import whole_steps
from ewif_jax.plain import in_dtype
from ewif_jax.streams import cast
from ewif_jax.types import (
    DTypeLike,
    Estimator,
    Gaussian,
    Info,
    Measurement,
    Numbers,
    Params,
    RandomKey,
    State,
    Status,
)


class Arrival(NamedTuple):
    """What one arrival does: the state that goes on, the state to report from, and diagnostics."""

    kept: Any
    reported: Any
    info: Info


class Screened(NamedTuple):
    """Measurements without what is not a number, and which rows were `refused` for it: bool with
    the shape of their times."""

    measurements: Measurement
    refused: Any


def screen(measurements: Measurement, dtype: DTypeLike) -> Screened:
    """Takes out what is not a number: a row whose time, or a present component or its square, is
    not finite in `dtype`, is masked as a whole.

    Any leading axes; with NumPy if all is NumPy's. It looks at whole arrays, before any scan: a
    filter whose gain looked at values could not share it over a batch of runs.
    """
    time, value, sensor, mask = measurements
    xp = jnp if any(isinstance(x, Array) for x in (time, value, mask)) else np
    with np.errstate(over="ignore", invalid="ignore"):
        # Squares, because a density needs them: 1e20 is a number in float32 whose square is none,
        # and its likelihood would be -inf in one entry and NaN in another.
        squares = xp.square(xp.asarray(value, dtype))
        present: Any = xp.broadcast_to(mask, np.shape(value))
        is_time = xp.broadcast_to(xp.isfinite(xp.asarray(time, dtype)), np.shape(value)[:-1])
        finite = is_time & xp.all(xp.isfinite(squares) | ~present, -1)
    refused = xp.any(present, -1) & ~finite
    return Screened(Measurement(time, value, sensor, present & finite[..., None]), refused)


def marked(info: Info, refused: Numbers) -> Info:
    """`info` of screened measurements, with the status of those that were refused."""
    status = jnp.where(refused, jnp.int32(Status.REJECTED), info.status)
    return info._replace(status=status)


def arrive(
    estimator: Estimator,
    params: Params,
    state: State,
    measurement: Measurement,
    clock_time: Array | None = None,
) -> Arrival:
    """Moves `state` to a screened measurement (or to the clock's time) and updates it.

    With nothing in the measurement (mask all False) and no clock the filter stays where it is;
    what is reported is its prediction. What lies between two steps of a discrete model is
    `REJECTED`, and moves nothing; so is a stamp ahead of the clock by more than rounding. A time
    that is not a number counts as the state's, or the clock's.
    """
    measurement = cast(existing(estimator.model, measurement), state.time.dtype)
    now = state.time if clock_time is None else jnp.maximum(state.time, clock_time)
    stamp = jnp.where(jnp.isfinite(measurement.time), measurement.time, now)
    now, refused = _clock_place(estimator, state.time, now, stamp, clock_time is not None)
    if refused is not None:
        # Masked, and at a time that the model can answer for: NaN would reach derivatives.
        shown_time = jnp.where(refused, now, stamp)
        shown = measurement._replace(time=shown_time, mask=measurement.mask & ~refused)
    else:
        shown = measurement._replace(time=stamp)
    target = jnp.maximum(now, shown.time) if clock_time is None else now
    moved = estimator.predict(params, state, target)
    updated, info = estimator.update(params, moved, shown)
    if refused is not None:
        status = jnp.where(
            refused & jnp.any(measurement.mask), jnp.int32(Status.REJECTED), info.status
        )
        info = info._replace(delay=jnp.where(refused, now - stamp, info.delay), status=status)
    if clock_time is not None:
        kept = updated if refused is None else choose(refused, state, updated)
        return Arrival(kept, updated, info)
    # A masked row moves nothing, so that padding is a no-op, but it is reported at its own time
    # (docs/decisions/contract.md: "A masked row does not move the filter").
    return Arrival(choose(jnp.any(shown.mask), updated, state), updated, info)


def _clock_place(
    estimator: Estimator, start: Array, now: Array, stamp: Array, by_clock: bool
) -> tuple[Array, Array | None]:
    """Where a filter at `start` is when its clock shows `now`, and whether a measurement of time
    `stamp` is to be refused there; None where none ever is."""
    refused = None
    steps = None if estimator.model is None else estimator.model.steps
    if steps is not None:
        in_step = whole_steps(steps, start, now)
        now = jnp.where(in_step, now, start)
        refused = ~in_step | ~whole_steps(steps, now, stamp)
    if by_clock:
        ahead = stamp > now + slack(jnp, stamp, now)
        refused = ahead if refused is None else refused | ahead
    return now, refused


def initial(
    estimator: Estimator,
    params: Params,
    prior: Gaussian | None,
    t0: Numbers,
    dtype: DTypeLike,
    key: RandomKey,
) -> Any:
    """The estimator's first state, with prior (left known where it is known) and t0 in `dtype`."""
    return estimator.init(params, prior_in(prior, dtype), jnp.asarray(t0, dtype), key)


def prior_in(prior: Gaussian | None, dtype: DTypeLike) -> Gaussian | None:
    """The prior in `dtype`, its value known as before."""
    return None if prior is None else Gaussian(*(in_dtype(x, dtype) for x in prior))
