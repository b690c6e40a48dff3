"""When things are measured and when they arrive: sampling, transport delay, loss."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ewif_jax import checks, clocks, plain
from ewif_jax.streams import float_dtype
from ewif_jax.types import Measurement, Numbers


class Delivery(NamedTuple):
    """A stream as it arrives: measurements, arrival (T,) seconds, not decreasing, and order (T,):
    which measurement of the input each arrival is. Lost ones are masked and keep their place."""

    measurements: Measurement
    arrival: Array
    order: Array


def regular_times(interval: Numbers, steps: int, start: Numbers = 0.0) -> Array:
    """(T,) start, start + interval, ... in seconds.

    Raises:
        ValueError: interval <= 0; steps < 1.
    """
    checks.positive("interval", interval)
    steps = checks.whole("steps", steps, 1)
    return start + interval * jnp.arange(steps)


def poisson_times(key: Array, mean_interval: Numbers, steps: int, start: Numbers = 0.0) -> Array:
    """(T,) the events of a Poisson process of rate 1 / mean_interval after `start`, seconds.

    Raises:
        ValueError: mean_interval <= 0; steps < 1.
    """
    checks.positive("mean_interval", mean_interval)
    steps = checks.whole("steps", steps, 1)
    return start + jnp.cumsum(mean_interval * jax.random.exponential(key, (steps,)))


def exponential_delays(key: Array, mean: Numbers, steps: int) -> Array:
    """(T,) exponentially distributed delays in seconds; `mean` may be () or (T,), zero included.

    Raises:
        ValueError: a negative mean; steps < 1.
    """
    checks.at_least("mean", mean, 0.0)
    return mean * jax.random.exponential(key, (checks.whole("steps", steps, 1),))


def uniform_delays(key: Array, low: Numbers, high: Numbers, steps: int) -> Array:
    """(T,) delays uniform in [low, high), seconds; the bounds may be () or (T,).

    Raises:
        ValueError: low < 0; high < low; steps < 1.
    """
    checks.at_least("low", low, 0.0)
    checks.at_least("high - low", jnp.asarray(high) - jnp.asarray(low), 0.0)
    return low + (high - low) * jax.random.uniform(key, (checks.whole("steps", steps, 1),))


def fixed_delays(delay: Numbers, steps: int) -> Array:
    """(T,) the same delay for all, seconds; `delay` may be () or (T,).

    Raises:
        ValueError: a negative delay; steps < 1.
    """
    checks.at_least("delay", delay, 0.0)
    return jnp.broadcast_to(jnp.asarray(delay), (checks.whole("steps", steps, 1),))


def by_sensor(table: Numbers, sensor: Array) -> Array:
    """(T,) the entry of `table` (S,) that belongs to each measurement's sensor: per-sensor means,
    bounds or delays for the functions above.

    Raises:
        ValueError: a table that is not (S,); a known sensor outside 0..S-1. (Inside a trace such a
            sensor gives NaN.)
    """
    checks.shape("table", table, ("S",))
    indices = checks.concrete_value(sensor)
    if indices is not None and indices.size:
        count = np.shape(table)[0]
        checks.require(indices.min() >= 0, "sensor", "an index >= 0", indices.min())
        checks.require(indices.max() < count, "sensor", f"an index below {count}", indices.max())
    table = jnp.asarray(table)
    table = table.astype(float_dtype(table))
    return table.at[jnp.asarray(sensor)].get(mode="fill", fill_value=jnp.nan)


def losses(key: Array, probability: Numbers, steps: int) -> Array:
    """(T,) True for what never arrives, independently with `probability` () or (T,).

    Raises:
        ValueError: a probability outside [0, 1]; steps < 1.
    """
    chances = checks.concrete_value(probability)
    if chances is not None:
        inside = np.all((chances >= 0) & (chances <= 1))
        checks.require(inside, "probability", "a number between 0 and 1", probability)
    return jax.random.bernoulli(key, probability, (checks.whole("steps", steps, 1),))


def deliver(
    time: Numbers,
    value: Numbers,
    delay: Numbers,
    *,
    sensor: Numbers = 0,
    lost: Numbers = None,
    mask: Numbers = None,
) -> Delivery:
    """The measurements in their order of arrival, time + delay.

    What arrives together arrives in the order given. A pure function of arrays, for use inside
    `jit` and `vmap`.

    Args:
        time: (T,) validity times in seconds, or date-times as in `stream`.
        value: (T, m); NaN means missing, as in `stream`.
        delay: () or (T,) seconds, >= 0.
        sensor: () or (T,) indices.
        lost: (T,) bool, what never arrives: it is masked.
        mask: (T, m) bool, which components exist; default: where `value` is finite.

    Reduces to: the same stream in its own order for delay 0 and increasing times.

    Raises:
        ValueError: wrong shapes; a negative delay; what `stream` refuses.
    """
    value = plain.numbers("value", value, missing=True)
    checks.shape("value", value, ("T", "m"))
    steps = value.shape[0]
    dtype = float_dtype(value)
    time, _, _ = clocks.in_seconds(time, name="time")
    checks.shape("time", time, (steps,))
    checks.finite("time", time)
    clocks.representable(dtype, time)
    time = jnp.asarray(time, dtype)
    checks.at_least("delay", delay, 0.0)
    sensor = jnp.broadcast_to(jnp.asarray(plain.indices("sensor", sensor)), (steps,))
    value = jnp.asarray(value, dtype)
    mask = jnp.isfinite(value) if mask is None else jnp.asarray(plain.booleans("mask", mask))
    checks.shape("mask", mask, value.shape)
    if lost is not None:
        checks.shape("lost", lost, (steps,))
        mask = mask & ~jnp.asarray(plain.booleans("lost", lost))[:, None]
    arrival = time + jnp.asarray(delay, dtype)
    order = jnp.argsort(arrival, stable=True)
    # What was lost keeps its number; what is none would reach derivatives.
    value = jnp.where(jnp.isfinite(value), value, 0)
    measurements = Measurement(time, value, sensor, mask)
    sorted_in = jax.tree.map(lambda x: x[order], measurements)
    return Delivery(sorted_in, arrival[order], order)
