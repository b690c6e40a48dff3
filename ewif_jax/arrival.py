"""The one body of an arrival, which `run`, `step`, `run_batch` and `run_parallel` share."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ewif_jax.streams import cast, in_dtype
from ewif_jax.types import Estimator, Gaussian, Info, Measurement, Status


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


def screen(measurements: Measurement, dtype: Any) -> Screened:
    """Takes out what is not a number: a row whose time, or a present component or its square, is
    not finite in `dtype`, is masked as a whole.

    Any leading axes; with NumPy if all is NumPy's. It looks at whole arrays, before any scan: a
    filter whose gain looked at values could not share it over a batch of runs.
    """
    time, value, sensor, mask = measurements
    xp = jnp if any(isinstance(x, Array) for x in (time, value, mask)) else np
    with np.errstate(over="ignore", invalid="ignore"):
        squares = xp.square(xp.asarray(value, dtype))
        finite = xp.isfinite(xp.asarray(time, dtype)) & xp.all(xp.isfinite(squares) | ~mask, -1)
    refused = xp.any(mask, -1) & ~finite
    return Screened(Measurement(time, value, sensor, mask & finite[..., None]), refused)


def marked(info: Info, refused: Any) -> Info:
    """`info` of screened measurements, with the status of those that were refused."""
    status = jnp.where(refused, jnp.int32(Status.REJECTED), info.status)
    return info._replace(status=status)


def arrive(
    estimator: Estimator,
    params: Any,
    state: Any,
    measurement: Measurement,
    clock_time: Array | None = None,
) -> Arrival:
    """Moves `state` to a screened measurement (or to the clock's time) and updates it.

    With nothing in the measurement (mask all False) and no clock the filter stays where it is;
    what is reported is its prediction. A time that is not a number counts as the state's.
    """
    measurement = cast(measurement, state.time.dtype)
    is_time = jnp.isfinite(measurement.time)
    asked = jnp.where(is_time, measurement.time, state.time) if clock_time is None else clock_time
    target = jnp.maximum(state.time, asked)
    measurement = measurement._replace(time=jnp.where(is_time, measurement.time, target))
    moved = estimator.predict(params, state, target)
    updated, info = estimator.update(params, moved, measurement)
    if clock_time is not None:
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
