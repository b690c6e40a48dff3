"""Streams of measurements from what people have."""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array

from ewif_jax import checks
from ewif_jax.fast.compiling import array
from ewif_jax.fast.memo import once
from ewif_jax.types import Measurement

checked_stream = once(checks.stream)
"""`checks.stream`, which passes over all numbers, once for the same arrays of JAX."""


def stream(time: Any, value: Any, sensor: Any = 0, mask: Any = None) -> Measurement:
    """A stream of measurements from plain arrays.

    Args:
        time: (T,) validity times in seconds, in order of arrival.
        value: (T,) or (T, m) numbers; NaN means missing unless `mask` is given.
        sensor: index or (T,) indices; default sensor 0.
        mask: (T,) or (T, m) bool; default: where `value` is finite.
    """
    # What JAX does not have yet needs no programs of JAX.
    xp = jnp if any(isinstance(x, Array) for x in (time, value, sensor, mask)) else np
    value = xp.asarray(value)
    value = value[:, None] if value.ndim == 1 else value
    checks.shape("value", value, ("T", "m"))
    dtype = float_dtype(value)
    with np.errstate(over="ignore"):  # what float32 cannot hold is not finite
        value = value.astype(dtype)
    mask = xp.isfinite(value) if mask is None else xp.asarray(mask, bool)
    mask = xp.broadcast_to(mask[:, None] if mask.ndim == 1 else mask, value.shape)
    checks.shape("time", time, (value.shape[0],))
    checks.resolvable(time, dtype)
    sensor = xp.broadcast_to(xp.asarray(sensor, np.int32), value.shape[:1])
    seen = xp.where(mask, value, 0)
    return Measurement(array(xp.asarray(time), dtype), array(seen), array(sensor), array(mask))


def float_dtype(x: Any) -> Any:
    """The float dtype that `x` has, or would be promoted to."""
    dtype = jnp.result_type(checks.with_dtype(x))
    return dtype if jnp.issubdtype(dtype, jnp.floating) else jnp.asarray(0.0).dtype


def cast(measurement: Measurement, dtype: Any) -> Measurement:
    """The measurement with floats in `dtype`, int32 sensors (left known where they are known), and
    zeros where nothing was seen."""
    mask = jnp.asarray(measurement.mask, bool)
    return Measurement(
        jnp.asarray(measurement.time, dtype),
        jnp.where(mask, jnp.asarray(measurement.value, dtype), 0),
        in_dtype(measurement.sensor, np.int32),
        mask,
    )


def in_dtype(x: Any, dtype: Any) -> Any:
    """`x` in `dtype`, its value known as before."""
    value = checks.known(x)
    return jnp.asarray(x, dtype) if value is None else value.astype(dtype)
