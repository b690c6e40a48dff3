"""Running an estimator: one arrival at a time (`step`) or a whole stream (`run`)."""

from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from ewif_jax import checks
from ewif_jax.compiling import QUICK, QUICKEST, array, quick_jit
from ewif_jax.types import Estimator, Gaussian, Info, Measurement, Status, Trace

Clock = Literal["validity", "arrival"]


class Arrival(NamedTuple):
    """What one arrival does: the state that goes on, the state to report from, and diagnostics."""

    kept: Any
    reported: Any
    info: Info


def advance(
    estimator: Estimator, params: Any, state: Any, measurement: Measurement, to: Array | None = None
) -> Arrival:
    """Moves `state` to the measurement (or to the clock time `to`) and updates it.

    With nothing in the measurement (mask all False) and no clock the filter stays where it is;
    what is reported is its prediction.
    """
    measurement = cast(measurement, state.time.dtype)
    target = jnp.maximum(state.time, measurement.time if to is None else to)
    moved = estimator.predict(params, state, target)
    updated, info = estimator.update(params, moved, measurement)
    if to is not None:
        return Arrival(updated, updated, info)
    present = jnp.any(measurement.mask)
    kept = jax.tree.map(lambda new, old: jnp.where(present, new, old), updated, state)
    return Arrival(kept, updated, info)


def step(
    estimator: Estimator, params: Any, state: Any, measurement: Measurement
) -> tuple[Any, Info]:
    """The state after one arrival, and its diagnostics: the body of `run` as a streaming call.

    The state moves to the measurement's time unless that is past (then the measurement is late).
    A measurement whose mask is all False changes nothing. One that is not a number (its time, or
    a present component or its square, is NaN or infinite) changes nothing either: `REJECTED`.

    Args:
        estimator: any `Estimator`.
        params: what its parameters are read from.
        state: from `estimator.init` or an earlier `step`.
        measurement: one arrival: time (), value (m,), sensor (), mask (m,).
    """
    measurement = cast(measurement, state.time.dtype)
    time, value, _, mask = measurement
    when = jnp.isfinite(time)
    good = when & jnp.all(jnp.isfinite(jnp.square(value)))
    usable = measurement._replace(time=jnp.where(when, time, state.time), mask=mask & good)
    arrival = advance(estimator, params, state, usable)
    status = jnp.where(good | ~jnp.any(mask), arrival.info.status, jnp.int32(Status.REJECTED))
    return arrival.kept, arrival.info._replace(status=status)


def run(
    estimator: Estimator,
    params: Any,
    measurements: Measurement,
    *,
    prior: Gaussian | None,
    t0: Any,
    times: Any = None,
    clock: Clock = "validity",
    key: Any = None,
) -> Trace:
    """Estimates after each arrival of a stream.

    Args:
        estimator: any `Estimator`.
        params: what its parameters are read from: any pytree, differentiable.
        measurements: T arrivals in their order of arrival, stacked on axis 0.
        prior: Gaussian at t0, or None for "unknown" where the estimator accepts it.
        t0: time of the prior in seconds.
        times: (T,) when to report after arrival k; default the running maximum of the times
            of what was measured (a masked row is predicted to its own). Reporting propagates a
            copy and never moves the filter.
        clock: "validity": the filter's time is the newest measurement's. "arrival": the filter
            itself moves to times[k] before update k, so any older measurement is late.
        key: PRNG key, for estimators that draw noise.

    Returns:
        A `Trace`: time (T,), mean (T, n), cov (T, n, n), info, final_state. The dtype is that of
        `measurements.value`.

    Raises:
        ValueError: unusable streams, priors, times or keys, before anything is traced.
    """
    checks.stream(measurements)
    state = validated(estimator, params, measurements, prior, t0, times, clock, key)
    measurements = Measurement(*map(checks.with_dtype, measurements))
    prior = _prior(prior, float_dtype(measurements.value))
    filtered = _compiled(measurements.time.shape[0], state, key)
    return filtered(estimator, params, measurements, prior, t0, times, clock, key)


def validated(
    estimator: Estimator,
    params: Any,
    measurements: Measurement,
    prior: Gaussian | None,
    t0: Any,
    times: Any,
    clock: str,
    key: Any,
) -> Any:
    """The shapes of the estimator's state, after everything else than the stream that can be known
    now has been checked."""
    checks.prior(prior)
    checks.shape("t0", t0, ())
    checks.finite("t0", t0)
    checks.require(clock in ("validity", "arrival"), "clock", "'validity' or 'arrival'", clock)
    needs_times = clock == "arrival" and times is None
    checks.require(not needs_times, "times", "arrival times, since clock='arrival'", None)
    dtype = float_dtype(measurements.value)
    checks.resolvable(measurements.time, dtype)
    if times is not None:
        checks.report_times(times, np.shape(measurements.time)[0])
    sensors = checks.known(measurements.sensor)
    last = None if sensors is None else np.int32(sensors.max())

    def first() -> Any:
        given = jax.tree.map(_indexable, params)
        state = initial(estimator, given, prior, t0, dtype, key)
        if not last and not jax.tree.leaves(params):
            return state  # nothing is known that the program itself would not refuse
        one = jax.tree.map(lambda x: jnp.asarray(x)[0], cast(measurements, dtype))
        if last is not None:  # a known index is checked where the model is asked about it
            one = one._replace(sensor=last)
        return advance(estimator, given, state, one, None if times is None else times[0]).kept

    shapes = np.shape(measurements.value), times is None, clock
    trial = _fingerprint((estimator, shapes, dtype, key is None), (params, prior, t0, last))
    if trial is None:
        return jax.eval_shape(first)
    if trial not in _tried:
        if len(_tried) >= 1000:
            _tried.clear()
        _tried[trial] = jax.eval_shape(first)
    return _tried[trial]


def _indexable(x: Any) -> Any:
    """`x`, its value known as before; but a NumPy table cannot be indexed while tracing."""
    with jax.ensure_compile_time_eval():
        return array(x) if isinstance(x, np.ndarray) else x


_tried: dict[Any, Any] = {}
"""What has gone through one trial arrival, and the shapes of the state that came out: trying takes
longer than filtering a short stream."""


def _fingerprint(structure: Any, values: Any) -> Any:
    """Equal for equal trials; None while something in `values` is not known."""
    leaves, tree = jax.tree.flatten(values)
    known = [x for x in map(checks.known, leaves) if x is not None]
    if len(known) < len(leaves):
        return None
    return structure, tree, tuple((x.shape, x.dtype.str, x.tobytes()) for x in known)


def initial(
    estimator: Estimator, params: Any, prior: Gaussian | None, t0: Any, dtype: Any, key: Any
) -> Any:
    """The estimator's first state, with prior (left known where it is known) and t0 in `dtype`."""
    return estimator.init(params, _prior(prior, dtype), jnp.asarray(t0, dtype), key)


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
        _in_dtype(measurement.sensor, np.int32),
        mask,
    )


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


def _prior(prior: Gaussian | None, dtype: Any) -> Gaussian | None:
    return None if prior is None else Gaussian(*(_in_dtype(x, dtype) for x in prior))


def _in_dtype(x: Any, dtype: Any) -> Any:
    value = checks.known(x)
    return jnp.asarray(x, dtype) if value is None else value.astype(dtype)


def verdict(
    late: Array,
    present: Array,
    late_status: Status | Array = Status.TOO_LATE,
    good: Array | bool = True,
) -> Array:
    """The status of an update that has nothing more to say than "late", "present" and "good"."""
    status = jnp.where(late, late_status, Status.USED)
    status = jnp.where(good | (status == Status.TOO_LATE), status, Status.REJECTED)
    return jnp.where(present, status, Status.MASKED).astype(jnp.int32)


def choose(condition: Array, yes: Any, no: Any) -> Any:
    """`yes` where the scalar `condition` holds, else `no`, for whole pytrees."""
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), yes, no)


def copies(tree: Any, count: int) -> Any:
    """`tree` so many times over, along a new leading axis of every leaf."""
    return jax.tree.map(lambda x: jnp.broadcast_to(x, (count, *jnp.shape(x))), tree)


def _filtered(
    estimator: Estimator,
    params: Any,
    measurements: Measurement,
    prior: Gaussian | None,
    t0: Any,
    times: Any,
    clock: Clock,
    key: Any,
) -> Trace:
    dtype = float_dtype(measurements.value)
    state = initial(estimator, params, prior, t0, dtype, key)
    times = None if times is None else jnp.asarray(times, dtype)

    def body(state: Any, arrival: tuple[Measurement, Array | None]) -> tuple[Any, tuple]:
        measurement, time = arrival
        moved = advance(estimator, params, state, measurement, time if clock == "arrival" else None)
        shown = moved.reported
        if time is not None and clock == "validity":
            shown = estimator.predict(params, shown, time)
        mean, cov = estimator.estimate(params, shown)
        return moved.kept, (shown.time, mean, cov, moved.info)

    state, (time, mean, cov, info) = lax.scan(body, state, (measurements, times))
    return Trace(time, mean, cov, info, state)


def _compiled(arrivals: int, state: Any, key: Any) -> Any:
    """`_filtered`, compiled as hard as so many arrivals and such a state deserve."""
    longest = max((x.shape[-1] for x in jax.tree.leaves(state) if x.ndim), default=1)
    if arrivals * max(longest, 100) <= 1e5:
        return _run_short
    # What draws random numbers has many members, and fills vectors.
    return _run_wide if key is not None and arrivals > 100 else _run_small


_STATIC = ("estimator", "clock")
_run_wide = jax.jit(_filtered, static_argnames=_STATIC)
_run_small = quick_jit(_filtered, _STATIC, QUICK)
_run_short = quick_jit(_filtered, _STATIC, QUICKEST)
