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

from ewif_jax import checks
from ewif_jax.arrival import arrive, initial, marked, screen
from ewif_jax.estimator import Clock
from ewif_jax.every_run import Content, examined, per_run_flags, same_runs
from ewif_jax.fast.compiling import WIDE, quick_jit, transformed
from ewif_jax.fast.layout import (
    Frozen,
    device_count,
    on_devices,
    over_devices,
)
from ewif_jax.fast.loops import Loop, over_runs
from ewif_jax.fast.slopes import with_few_slopes
from ewif_jax.latency import on_time
from ewif_jax.streams import float_dtype, given
from ewif_jax.types import (
    DTypeLike,
    Estimator,
    Gaussian,
    Info,
    Measurement,
    Numbers,
    Parameter,
    Params,
    PyTree,
    RandomKey,
    State,
    Trace,
)


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
    params: Params,
    measurements: Measurement,
    *,
    prior: Gaussian | None,
    t0: Numbers,
    times: Numbers = None,
    clock: Clock = "validity",
    key: RandomKey = None,
    latency: Parameter = None,
    params_per_run: PyTree = False,
    observe: Observer | None = None,
    context: PyTree = None,
    context_per_run: PyTree = False,
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
        latency: as in `run`; of a function of parameters that differ by run, each run's own.
        params_per_run: True, False, or a pytree prefix of `params` of these.
        observe: function (Step of one arrival, its context) -> pytree to return instead of
            everything; what it does not use is not computed.
        context: pytree of what else `observe` sees of each arrival, leaves (T, ...), or
            (R, T, ...) where marked in `context_per_run` (a prefix, like `params_per_run`).
        devices: how many local devices share the runs, at most; as many as divide R. Default all;
            one CPU where the call is part of another program (a jitted or differentiated loss).

    Returns:
        A `Trace` whose leaves lead with R: mean (R, T, n); or the pytree of `observe`.

    Raises:
        ValueError: what `run` refuses, in any run; arguments whose numbers of runs or arrivals
            differ; parameters with an axis of runs that is not marked.
    """
    checks.estimator(estimator)
    params, measurements, prior, t0, times = given(
        params, measurements, prior, t0, times, batched=True
    )
    per_run = per_run_flags("params", params_per_run, params)
    measurements = on_time(estimator.model, latency, params, measurements, per_run)
    input_flags, content, sifted = examined(
        estimator, params, params_per_run, measurements, prior, t0, times, clock, key
    )
    measurements, refused = sifted or (measurements, None)
    runs, steps = np.shape(measurements.value)[:2]
    context_flags = per_run_flags("context", context_per_run, context)
    same_runs("context", context, context_flags, runs, steps)
    seen_flags = (context_flags, None if refused is None else True)
    flags = (*input_flags, None if key is None else True, seen_flags)
    keys = key
    if key is not None and not (checks.is_typed_key(key) and key.ndim == 1):
        keys = jax.random.split(key, runs)
    count = device_count(runs, devices)
    inputs = (params, measurements, prior, times, keys, (context, refused))
    inputs = on_devices(inputs, flags, count)
    return _run_batch(
        estimator, inputs, t0, Frozen(flags), clock, observe, count, content, transformed()
    )


def _filtered_runs(
    estimator: Estimator,
    inputs: PyTree,
    t0: Numbers,
    flags: Frozen,
    clock: Clock,
    observe: Observer | None,
    devices: int,
    content: Content,
    is_part: bool,
) -> Any:
    params, measurements, prior, times, keys, context = inputs
    dtype = float_dtype(measurements.value)
    measurements = measurements._replace(
        time=jnp.asarray(measurements.time, dtype), value=jnp.asarray(measurements.value, dtype)
    )
    times = None if times is None else jnp.asarray(times, dtype)
    inputs = (params, measurements, prior, times, keys, context)
    loop = _run_loop(estimator, t0, clock, observe or _observe_everything, content.complete, dtype)

    def filtered(*inputs: Any) -> Any:
        return over_runs(loop, estimator.estimate, inputs, flags.tree)

    def screened(*inputs: Any) -> Any:
        return _screened_runs(loop, estimator, inputs, flags.tree, dtype)

    run = filtered if content.screened else screened
    on_all = over_devices(run, flags.tree, devices)
    if is_part:  # of a program that may be differentiated
        on_all = with_few_slopes(on_all, flags.tree)
    seen, state = on_all(*inputs)
    if observe is not None:
        return seen
    time, mean, cov, info = seen
    return Trace(time, mean, cov, info, state)


def _screened_runs(
    loop: Loop, estimator: Estimator, inputs: PyTree, flags: PyTree, dtype: DTypeLike
) -> Any:
    """The same of values that nobody has looked at. A mask for each run costs each run a gain of
    its own, so one condition over the whole batch decides whether it is needed."""
    params, measurements, prior, times, keys, (context, _) = inputs
    params_f, measurements_f, prior_f, times_f, keys_f, (context_f, _) = flags
    kept, refused = screen(measurements, dtype)

    def own_masks() -> Any:
        masked_f = measurements_f._replace(mask=True)
        own = (params, kept, prior, times, keys, (context, refused))
        own_f = (params_f, masked_f, prior_f, times_f, keys_f, (context_f, True))
        return over_runs(loop, estimator.estimate, own, own_f)

    if measurements_f.mask:
        return own_masks()
    # `cond` over the whole batch runs one of the two: the shared gains are paid for only once, and
    # a batch without a bad row never computes its own (docs/decisions/contract.md).
    return lax.cond(
        jnp.any(refused), own_masks, lambda: over_runs(loop, estimator.estimate, inputs, flags)
    )


_STATIC = ("estimator", "flags", "clock", "observe", "devices", "content", "is_part")
_run_batch = quick_jit(_filtered_runs, _STATIC, WIDE)


def _run_loop(
    estimator: Estimator,
    t0: Numbers,
    clock: Clock,
    observe: Observer,
    complete: bool,
    dtype: DTypeLike,
) -> Loop:
    def start(params: Params, prior: Gaussian | None, key: RandomKey) -> Any:
        return initial(estimator, params, prior, t0, dtype, key)

    def step(params: Params, state: State, arrival: Numbers) -> tuple[Any, Any]:
        measurement, time, (seen, refused) = arrival
        # A mask that is known to be whole is made a constant: what keeps the old state of empty
        # rows is then compiled away.
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


def _observe_everything(step: Step, context: PyTree) -> Step:
    del context
    return step
