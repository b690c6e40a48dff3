"""Streams of measurements from what people have, and what every entry makes of what it is given."""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from ewif_jax import checks, clocks, plain
from ewif_jax.fast.compiling import array
from ewif_jax.fast.memo import once
from ewif_jax.types import DTypeLike, Gaussian, Measurement, Numbers, Params

checked_stream = once(checks.stream)
"""`checks.stream`, which passes over all numbers, once for the same arrays of JAX."""


def stream(
    time: Numbers,
    value: Numbers,
    sensor: Numbers = 0,
    mask: Numbers = None,
    *,
    arrival: Numbers = None,
) -> Measurement:
    """A stream of measurements from plain arrays.

    Args:
        time: (T,) validity times in seconds, in order of arrival. Date-times (datetime64,
            `datetime`, pandas with or without a time zone) become seconds since the first row
            given, in float64 until the filter's dtype is known; durations become seconds.
        value: (T,) or (T, m) numbers, or a list of T arrays, as long as the sensors have
            components, that is filled up to the longest; NaN, None and masked elements mean missing
            (with a `mask` given, masked elements do, and the rest is as `mask` says). float16 and
            narrower values become float32: no filter runs in them.
        sensor: index or (T,) indices, whole numbers >= 0; default sensor 0.
        mask: (T,) or (T, m) booleans, or a list of T arrays; default: where `value` is finite.
        arrival: (T,) when each arrives, in any order: the stream is sorted by it, what arrives
            together in the order given. `arrival_order` gives the same order for what goes along
            (report times, truth).

    Raises:
        ValueError: wrong shapes; values that are complex, words or objects; times that are not
            finite, or that the dtype of the values cannot hold (`clocks.representable`); fractions
            among the sensors; a mask of anything else than booleans.
    """
    time, _, _ = clocks.in_seconds(time, name="time")
    value = plain.equal_rows("value", value, np.nan)
    mask = plain.equal_rows("mask", mask, False)
    hidden = np.ma.getmaskarray(value) if isinstance(value, np.ma.MaskedArray) else None
    value = plain.numbers("value", value.filled(0) if hidden is not None else value, missing=True)
    sensor = plain.indices("sensor", sensor)
    mask = None if mask is None else plain.booleans("mask", mask)
    # What JAX does not have yet needs no programs of JAX.
    xp = jnp if any(isinstance(x, Array) for x in (time, value, sensor, mask)) else np
    value = value[:, None] if value.ndim == 1 else value
    checks.shape("value", value, ("T", "m"))
    dtype = float_dtype(value)
    with np.errstate(over="ignore"):  # what float32 cannot hold is not finite
        value = xp.asarray(value).astype(dtype)
    mask = xp.isfinite(value) if mask is None else xp.asarray(mask)
    mask = mask[:, None] if mask.ndim == 1 else mask
    steps = value.shape[0]
    fits = mask.ndim == 2 and mask.shape[0] == steps and mask.shape[1] in (1, value.shape[1])
    checks.require(fits, "mask", f"shape {(steps,)} or {value.shape}", f"shape {mask.shape}")
    mask = xp.broadcast_to(mask, value.shape)
    if hidden is not None:
        mask = mask & ~hidden.reshape(value.shape)
    checks.shape("time", time, (steps,))
    checks.finite("time", time)
    clocks.representable(dtype, time)
    checks.require(np.ndim(sensor) < 2, "sensor", f"shape () or {(steps,)}", np.shape(sensor))
    if np.ndim(sensor):
        checks.shape("sensor", sensor, (steps,))
    sensor = xp.broadcast_to(sensor, (steps,))
    # Zeros in place of what is absent: a NaN behind a mask would still reach a gradient, as 0 times
    # NaN.
    seen = xp.where(mask, value, 0)
    rows = Measurement(array(xp.asarray(time), dtype), array(seen), array(sensor), array(mask))
    if arrival is None:
        return rows
    order = arrival_order(arrival)
    checks.shape("arrival", order, (steps,))
    return Measurement(*(x[order] for x in rows))


def arrival_order(arrival: Numbers) -> Any:
    """(T,) indices that put what arrives at `arrival` (T,) in order of arrival; what arrives
    together stays in the order given. Numbers or date-times.

    Raises:
        ValueError: not (T,), not finite, not times.
    """
    seconds, _, _ = clocks.in_seconds(arrival, name="arrival")
    checks.shape("arrival", seconds, ("T",))
    checks.finite("arrival", seconds)
    if isinstance(seconds, Array):
        return jnp.argsort(seconds, stable=True)
    return np.argsort(seconds, kind="stable")


def newest(times: Numbers, truth: Numbers) -> Any:
    """(T, ...) for each arrival the row of `truth` that belongs to the newest time so far.

    Args:
        times: (T,) validity times in their order of arrival.
        truth: (T, ...) the truth at each of these times.

    Returns:
        What `run` estimates by default: the truth at the running maximum of `times`.

    Raises:
        ValueError: wrong shapes, times that are not numbers.
    """
    times = plain.numbers("times", times)
    checks.shape("times", times, ("T",))
    truth = plain.numbers("truth", truth)
    rows = np.shape(truth)[:1] == np.shape(times)
    checks.require(rows, "truth", f"{np.shape(times)[0]} rows", f"shape {np.shape(truth)}")
    if isinstance(times, Array) or isinstance(truth, Array):
        times, truth = jnp.asarray(times), jnp.asarray(truth)
        latest = jnp.where(
            times >= jnp.asarray(_running_maximum(jnp, times)), jnp.arange(times.size), 0
        )
        return truth[_running_maximum(jnp, latest)]
    latest = np.where(times >= _running_maximum(np, times), np.arange(times.size), 0)
    return truth[_running_maximum(np, latest)]


def _running_maximum(xp: Any, x: Numbers) -> Any:
    """The running maximum."""
    return xp.maximum.accumulate(x)


class Given(NamedTuple):
    """What an entry was given, as plain arrays: of JAX, or of NumPy in native byte order."""

    params: Any
    measurements: Measurement
    prior: Gaussian | None
    t0: Any
    times: Any


def given(
    params: Params,
    measurements: Measurement,
    prior: Gaussian | None,
    t0: Numbers,
    times: Numbers,
    batched: bool = False,
) -> Given:
    """What an entry was given, as plain arrays; the one converter of every entry.

    Date-times become seconds since the first element of `measurements.time` (see `clocks`), whole
    numbers floats, other byte orders native. Arrays of JAX stay the same objects.

    Raises:
        ValueError: what is wrong with the stream, with t0 or the shape of report times, what is not
            numbers, and times that the filter's dtype cannot hold.
    """
    ok = isinstance(measurements, Measurement)
    checks.require(ok, "measurements", "a Measurement", type(measurements).__name__)
    time, value, sensor, mask = measurements
    time, t0, times = clocks.in_seconds(time, t0, times)
    sensor = plain.native(checks.with_dtype(sensor, "measurements.sensor"))
    mask = checks.with_dtype(mask, "measurements.mask")
    measurements = Measurement(time, present_values(value, mask), sensor, mask)
    checked_stream(measurements, batched)
    if t0 is not None:
        checks.shape("t0", t0, ())
        checks.finite("t0", t0)
    if times is not None:
        lead = ("R",) if batched and np.ndim(times) == 2 else ()
        checks.shape("times", times, (*lead, "K"))
        checks.finite("times", times)
    clocks.representable(float_dtype(measurements.value), time, t0, times)
    if isinstance(prior, Gaussian):
        mean, cov = prior
        prior = Gaussian(plain.numbers("prior.mean", mean), plain.numbers("prior.cov", cov))
    return Given(plain.parameters(params), measurements, prior, t0, times)


def present_values(value: Numbers, mask: Numbers) -> Any:
    """The values as plain numbers, where nothing that a masked array hides is said to be there.

    Raises:
        ValueError: what is not numbers, or hidden and said to be present.
    """
    if isinstance(value, np.ma.MaskedArray) and np.ma.is_masked(value):
        hidden, seen = np.ma.getmaskarray(value), checks.concrete_value(mask)
        # In a batch all runs may share a mask.
        if seen is None or seen.dtype != bool:
            return plain.numbers("measurements.value", value)
        fits = seen.shape in (hidden.shape, hidden.shape[1:])
        if fits and not (hidden & seen).any():
            value = value.filled(0)
    return plain.numbers("measurements.value", value)


def float_dtype(x: Numbers) -> Any:
    """The float dtype that a filter of `x` runs in: that of `x` or the default, but nothing
    narrower than float32."""
    dtype = jnp.result_type(plain.native(checks.with_dtype(x)))
    if not jnp.issubdtype(dtype, jnp.floating):
        return jnp.asarray(0.0).dtype
    return dtype if dtype.itemsize >= 4 else np.dtype(np.float32)


def cast(measurement: Measurement, dtype: DTypeLike) -> Measurement:
    """The measurement with floats in `dtype`, int32 sensors (left known where they are known), and
    zeros where nothing was seen."""
    mask = jnp.asarray(measurement.mask, bool)
    return Measurement(
        jnp.asarray(measurement.time, dtype),
        jnp.where(mask, jnp.asarray(measurement.value, dtype), 0),
        plain.in_dtype(measurement.sensor, np.int32),
        mask,
    )
