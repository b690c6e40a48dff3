"""Sensors whose clocks or transports are late by seconds that are known, or that are tuned."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ewif_jax import checks
from ewif_jax.fast.layout import broadcast_prefix
from ewif_jax.models import Model
from ewif_jax.models.parameters import resolve
from ewif_jax.streams import float_dtype
from ewif_jax.types import Measurement, Numbers, Parameter, Params, PyTree, Steps

_LATENCY = "seconds: a number, one for each sensor (S,), or a function of params that gives these"


def corrected(measurements: Measurement, latency: Parameter, params: Params = None) -> Measurement:
    r"""The measurements with the latency of each sensor taken out of their times.

    .. math::
        t_k \leftarrow t_k - \lambda_{s_k}

    with :math:`\lambda_s` the seconds by which the stamps of sensor s are late. The rows stay in
    their order of arrival: one that is now older than those before it is a late measurement.

    Args:
        measurements: a stream (T, ...), a batch (R, T, ...), or one arrival.
        latency: seconds, a number, (S,) for S sensors, or a function of `params` that gives these;
            positive where the stamp is later than what was measured.
        params: what a function reads.

    Returns:
        The same measurements at other times; differentiable in the latency.

    Raises:
        ValueError: a latency that is not finite, or of another shape; a known sensor that it has
            no number for.

    Example:
        >>> import ewif_jax as ej
        >>> rows = ej.stream([0.0, 1.0, 1.1], [0.0, 1.0, 0.8], sensor=[0, 0, 1])
        >>> print(ej.corrected(rows, [0.0, 0.25]).time)
        [0.   1.   0.85]
    """
    ok = isinstance(measurements, Measurement)
    checks.require(ok, "measurements", "a Measurement", type(measurements).__name__)
    return _shifted(measurements, _checked_latency(resolve(latency, params), measurements.sensor))


def on_time(
    model: Model | None,
    latency: Parameter,
    params: Params,
    measurements: Measurement,
    params_per_run: PyTree = False,
) -> Measurement:
    """What `corrected` gives for an entry's argument `latency`, or for the model's own; the same
    object where there is none. A leaf of `params` marked in `params_per_run` leads with runs.

    Raises:
        ValueError: a latency given twice; one of a discrete model that is a parameter, or not
            whole steps.
    """
    own = None if model is None else model.latency
    if latency is None and own is None:
        return measurements
    checks.require(
        latency is None or own is None,
        "latency",
        "None, since the model's sensors have latencies of their own",
        checks.Shown(latency),
    )
    latency = own if latency is None else latency
    if model is not None and model.steps is not None:
        _check_whole_steps(model.steps, latency)
    if not callable(latency):
        return corrected(measurements, latency)
    flags = broadcast_prefix(params_per_run, params)
    if not any(jax.tree.leaves(flags)):
        return corrected(measurements, latency, params)
    axes = jax.tree.map(lambda per_run: 0 if per_run else None, flags)
    stamped = np.ndim(measurements.value) - 1
    time_axis, sensor_axis = (
        0 if np.ndim(x) == stamped else None for x in (measurements.time, measurements.sensor)
    )

    def times_of_run(params: Params, time: Array, sensor: Array) -> Array:
        run = measurements._replace(time=time, sensor=sensor)
        return jnp.asarray(corrected(run, latency, params).time)

    by_run = jax.vmap(times_of_run, in_axes=(axes, time_axis, sensor_axis))
    times = by_run(params, jnp.asarray(measurements.time), jnp.asarray(measurements.sensor))
    return measurements._replace(time=times)


def _checked_latency(latency: Numbers, sensor: Numbers) -> Any:
    """A latency () or (S,)."""
    if checks.concrete_value(latency) is not None:
        latency = np.asarray(latency)
        is_number = latency.dtype.kind in "iuf"
        checks.require(is_number, "latency", _LATENCY, f"dtype {latency.dtype}")
        checks.finite("latency", latency)
    checks.require(np.ndim(latency) < 2, "latency", _LATENCY, f"shape {np.shape(latency)}")
    index = checks.concrete_value(sensor)
    if np.ndim(latency) and index is not None and index.size:
        needed, count = int(index.max()) + 1, np.shape(latency)[0]
        checks.require(needed <= count, "latency", f"one for each of {needed} sensors", f"{count}")
    return latency


def _shifted(measurements: Measurement, latency: Numbers) -> Measurement:
    time, sensor = measurements.time, measurements.sensor
    at_hand = [checks.concrete_value(x) for x in (time, sensor, latency)]
    if any(x is None for x in at_hand):
        xp, dtype = jnp, float_dtype(measurements.value)
        time, latency = jnp.asarray(time, dtype), jnp.asarray(latency, dtype)
    else:
        # In float64, as times are given: the filter's dtype rounds once, the difference.
        xp, (time, sensor, latency) = np, at_hand
        time = np.asarray(time, float)
    shift = latency if np.ndim(latency) == 0 else latency[sensor]
    shape = np.broadcast_shapes(np.shape(time), np.shape(shift))
    times = xp.broadcast_to(time, shape) - xp.broadcast_to(shift, shape)
    return measurements._replace(time=times)


def _check_whole_steps(steps: Steps, latency: Parameter) -> None:
    """A discrete model knows no time between two steps, so its latencies are known whole steps."""
    constant = None if callable(latency) else checks.concrete_value(latency)
    expected = f"known whole steps of dt = {steps.dt:g} s, since the model is discrete"
    remedy = "; models.from_continuous makes one that is not"
    got = "a parameter" if constant is None else checks.Shown(latency)
    whole = constant is not None and _all_whole(constant / steps.dt)
    checks.require(whole, "latency", expected + remedy, got)


def _all_whole(count: np.ndarray) -> bool:
    return bool((np.abs(count - np.round(count)) <= 0.01).all())
