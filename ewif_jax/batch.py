"""Many runs of one estimator at once, in the memory layout that CPUs like.

Inside, the runs are the last axis of every array and the scan goes over time outside of `vmap`, so
each small-matrix operation becomes one long vector operation. What does not depend on the run (the
covariance, when times, masks and parameters are shared) is found by following the data flow, and
computed once, ahead of the rest. Outside, runs lead.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.core import Tracer

from ewif_jax import checks
from ewif_jax.arrival import Screened, arrive, initial, marked, screen
from ewif_jax.estimator import Clock
from ewif_jax.fast.compiling import WIDE, quick_jit
from ewif_jax.fast.layout import (
    Frozen,
    broadcast_prefix,
    device_count,
    on_devices,
    one_run,
    over_devices,
)
from ewif_jax.fast.loops import Loop, over_runs
from ewif_jax.fast.memo import once
from ewif_jax.models.entry import check_times
from ewif_jax.streams import float_dtype
from ewif_jax.trial import validated
from ewif_jax.types import Estimator, Gaussian, Info, Measurement, Trace


class Step(NamedTuple):
    """What an observer of a batch sees of one run after one arrival."""

    time: Array
    mean: Array
    cov: Array
    info: Info


Observer = Callable[[Step, Any], Any]
"""(Step, context of this run and arrival) -> what to keep of them."""


def run_batch(
    estimator: Estimator,
    params: Any,
    measurements: Measurement,
    *,
    prior: Gaussian | None,
    t0: Any,
    times: Any = None,
    clock: Clock = "validity",
    key: Any = None,
    params_per_run: Any = False,
    observe: Observer | None = None,
    context: Any = None,
    context_per_run: Any = False,
    devices: int | None = None,
) -> Any:
    """The same numbers as `vmap(run)`, many times faster on a CPU.

    Args:
        estimator: any `Estimator`.
        params: parameters; leaves marked in `params_per_run` have a leading axis of R runs.
        measurements: R streams of T arrivals: value (R, T, m); time, sensor and mask likewise, or
            without the leading axis where all runs share them (that is what makes it fast).
        prior: Gaussian at t0, its leaves with a leading axis R if they differ by run; or None.
        t0: time of the prior in seconds.
        times: (T,) or (R, T) report times as in `run`.
        clock: as in `run`.
        key: PRNG key, split over the runs; or (R,) typed keys, one for each.
        params_per_run: True, False, or a pytree prefix of `params` of these.
        observe: function (Step of one arrival, its context) -> pytree to return instead of
            everything; what it does not use is not computed.
        context: pytree of what else `observe` sees of each arrival, leaves (T, ...), or
            (R, T, ...) where marked in `context_per_run` (a prefix, like `params_per_run`).
        devices: how many local devices share the runs, at most; as many as divide R. Default all;
            one CPU where the call is part of another program (a jitted or differentiated loss).

    Returns:
        A `Trace` whose leaves lead with R: mean (R, T, n); or the pytree of `observe`.
    """
    input_flags, content, sifted = _examined(
        estimator, params, params_per_run, measurements, prior, t0, times, clock, key
    )
    measurements, refused = sifted or (measurements, None)
    runs = np.shape(measurements.value)[0]
    flags = (
        *input_flags,
        None if key is None else True,
        (broadcast_prefix(context_per_run, context), None if refused is None else True),
    )
    keys = key if key is None or _one_for_each(key) else jax.random.split(key, runs)
    count = device_count(runs, devices)
    inputs = (params, measurements, prior, times, keys, (context, refused))
    inputs = on_devices(inputs, flags, count)
    return _run_batch(estimator, inputs, t0, Frozen(flags), clock, observe, count, content)


class Content(NamedTuple):
    """What is known of the values of a batch before anything is compiled."""

    complete: bool
    """Nothing is masked, which the compiled program then need not look for."""
    screened: bool
    """What is not a number has been taken out (see `screen`)."""


@once
def _examined(
    estimator: Estimator,
    params: Any,
    params_per_run: Any,
    measurements: Measurement,
    prior: Gaussian | None,
    t0: Any,
    times: Any,
    clock: Clock,
    key: Any,
) -> tuple[Any, Content, Screened | None]:
    """Which inputs differ by run, what is known of the values, and the measurements without what
    is not a number if there is such; everything that can be refused now is."""
    checks.stream(measurements, batched=True)
    checks.shape("measurements.value", measurements.value, ("R", "T", "m"))
    sifted = _sifted(measurements)
    shown = sifted.measurements if sifted else measurements
    inputs, flags = flagged(params, params_per_run, shown, prior, times)
    check_runs(estimator, inputs, flags, t0, clock, key)
    mask = checks.known(shown.mask)
    complete = mask is not None and bool(mask.all())
    return flags, Content(complete, _values_at_hand(measurements)), sifted


def _values_at_hand(measurements: Measurement) -> bool:
    return not any(isinstance(x, Tracer) for x in measurements)


def _sifted(measurements: Measurement) -> Screened | None:
    """The measurements at hand without what is not a number; None if all are numbers. Only a batch
    in which some are not pays for a mask, and so a gain, for every run."""
    dtype = float_dtype(measurements.value)
    if not _values_at_hand(measurements):
        return None
    value = np.asarray(measurements.value)
    if value.dtype == dtype and checks.squares_are_finite(measurements.value):
        return None
    screened = screen(jax.tree.map(np.asarray, measurements), dtype)
    return screened if screened.refused.any() else None


def _one_for_each(key: Any) -> bool:
    """Whether these are typed keys along an axis of runs (a raw key has an axis of its own)."""
    return jnp.ndim(key) == 1 and jnp.issubdtype(key.dtype, jax.dtypes.prng_key)


def flagged(
    params: Any, params_per_run: Any, measurements: Measurement, prior: Gaussian | None, times: Any
) -> tuple[Any, Any]:
    """(params, measurements, prior, times), and the same with a bool for each leaf: whether it has
    a leading axis of runs."""
    flags = (
        broadcast_prefix(params_per_run, params),
        _ranked(measurements, (1, 2, 1, 2)),
        None if prior is None else _ranked(prior, (1, 2)),
        None if times is None else jnp.ndim(times) == 2,
    )
    return (params, measurements, prior, times), flags


def _ranked(fields: Any, ranks: tuple[int, ...]) -> Any:
    """Which fields of a named tuple have more axes than one run needs."""
    return type(fields)(*(jnp.ndim(x) > rank for x, rank in zip(fields, ranks, strict=True)))


def check_runs(
    estimator: Estimator, inputs: Any, flags: Any, t0: Any, clock: Clock, key: Any
) -> None:
    """Refuses what `run` refuses, with the first run for all, the largest sensor of any run, and
    the parameters also of the runs in which one of them is lowest."""
    params, params_f = inputs[0], flags[0]
    dtype = float_dtype(inputs[1].value)
    check_times(estimator.model, inputs[1], t0, dtype, inputs[3])
    _, measurements, prior, times = one_run(inputs, flags)
    sensors = checks.known(inputs[1].sensor)
    if sensors is not None and sensors.ndim == 2:
        measurements = measurements._replace(sensor=sensors.max(0))
    one_key = key[0] if key is not None and _one_for_each(key) else key
    for k in {0, *_lowest(params, params_f)}:
        own = one_run(params, params_f, k)
        validated(estimator, own, measurements, prior, t0, times, clock, one_key)


def _lowest(params: Any, flags: Any) -> set[int]:
    """Where the numbers that each run has of its own are lowest, or not numbers."""
    numbers = [
        checks.known(x)
        for x, f in zip(*map(jax.tree.leaves, (params, flags)), strict=True)
        if f and jnp.ndim(x) == 1 and jnp.issubdtype(jnp.result_type(x), jnp.number)
    ]
    finite = [np.where(np.isfinite(x), x, -np.inf) for x in numbers if x is not None]
    return {int(np.argmin(x)) for x in finite}


def _filtered(
    estimator: Estimator,
    inputs: Any,
    t0: Any,
    flags: Frozen,
    clock: Clock,
    observe: Observer | None,
    devices: int,
    content: Content,
) -> Any:
    params, measurements, prior, times, keys, context = inputs
    dtype = float_dtype(measurements.value)
    measurements = measurements._replace(
        time=jnp.asarray(measurements.time, dtype), value=jnp.asarray(measurements.value, dtype)
    )
    times = None if times is None else jnp.asarray(times, dtype)
    inputs = (params, measurements, prior, times, keys, context)
    loop = _loop(estimator, t0, clock, observe or _everything, content.complete, dtype)

    def filtered(*inputs: Any) -> Any:
        return over_runs(loop, estimator.estimate, inputs, flags.tree)

    def screened(*inputs: Any) -> Any:
        return _screened(loop, estimator, inputs, flags.tree, dtype)

    run = filtered if content.screened else screened
    seen, state = over_devices(run, flags.tree, devices)(*inputs)
    if observe is not None:
        return seen
    time, mean, cov, info = seen
    return Trace(time, mean, cov, info, state)


def _screened(loop: Loop, estimator: Estimator, inputs: Any, flags: Any, dtype: Any) -> Any:
    """The same of values that nobody has looked at. A mask for each run costs each run a gain of
    its own, so one condition over the whole batch decides whether it is needed."""
    params, measurements, prior, times, keys, (context, _) = inputs
    params_f, measurements_f, prior_f, times_f, keys_f, (context_f, _) = flags
    kept, refused = screen(measurements, dtype)

    def own_masks() -> Any:
        rows = jnp.broadcast_to(refused, measurements.value.shape[:2])
        mask = jnp.broadcast_to(kept.mask, measurements.value.shape)
        masked = kept._replace(mask=mask)
        masked_f = measurements_f._replace(mask=True)
        own = (params, masked, prior, times, keys, (context, rows))
        own_f = (params_f, masked_f, prior_f, times_f, keys_f, (context_f, True))
        return over_runs(loop, estimator.estimate, own, own_f)

    if measurements_f.mask:
        return own_masks()
    return lax.cond(
        jnp.any(refused), own_masks, lambda: over_runs(loop, estimator.estimate, inputs, flags)
    )


_STATIC = ("estimator", "flags", "clock", "observe", "devices", "content")
_run_batch = quick_jit(_filtered, _STATIC, WIDE)


def _loop(
    estimator: Estimator, t0: Any, clock: Clock, observe: Observer, complete: bool, dtype: Any
) -> Loop:
    def start(params: Any, prior: Any, key: Any) -> Any:
        return initial(estimator, params, prior, t0, dtype, key)

    def step(params: Any, state: Any, arrival: Any) -> tuple[Any, Any]:
        measurement, time, (seen, refused) = arrival
        if complete and refused is None:
            measurement = measurement._replace(mask=jnp.ones(measurement.mask.shape, bool))
        to = time if clock == "arrival" else None
        moved = arrive(estimator, params, state, measurement, to)
        shown = moved.reported
        if time is not None and clock == "validity":
            shown = estimator.predict(params, shown, time)
        mean, cov = estimator.estimate(params, shown)
        info = moved.info if refused is None else marked(moved.info, refused)
        return moved.kept, observe(Step(shown.time, mean, cov, info), seen)

    return Loop(start, step)


def _everything(step: Step, context: Any) -> Step:
    del context
    return step
