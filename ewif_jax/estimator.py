"""Running an estimator over a whole stream."""

from functools import partial
from typing import Any, Literal

import jax
import jax.numpy as jnp
from jax import Array, lax

from ewif_jax import checks
from ewif_jax.arrival import arrive, initial, marked, prior_in, screen
from ewif_jax.fast.compiling import QUICK, QUICKEST, quick_jit, transformed
from ewif_jax.fast.slopes import with_few_slopes
from ewif_jax.latency import on_time
from ewif_jax.models.components import check_components
from ewif_jax.streams import float_dtype, given
from ewif_jax.trial import validated
from ewif_jax.types import (
    Estimator,
    Gaussian,
    Measurement,
    Numbers,
    Parameter,
    Params,
    RandomKey,
    State,
    Trace,
)

Clock = Literal["validity", "arrival"]


def run(
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
        latency: seconds by which the stamps of each sensor are late: a number, (S,), or a function
            of `params`; taken out of the times first, see `corrected`.

    Returns:
        A `Trace`: time (T,), mean (T, n), cov (T, n, n), info, final_state. The dtype is that of
        `measurements.value`.

    Raises:
        ValueError: unusable streams, priors, times or keys, before anything is traced.
    """
    checks.estimator(estimator)
    params, measurements, prior, t0, times = given(params, measurements, prior, t0, times)
    check_components(estimator.model, measurements)
    measurements = on_time(estimator.model, latency, params, measurements)
    state = validated(estimator, params, measurements, prior, t0, times, clock, key)
    prior = prior_in(prior, float_dtype(measurements.value))
    filtered = _compiled_run(measurements.time.shape[0], state, key)
    return filtered(estimator, clock, params, measurements, prior, t0, times, key)


def _filtered_run(
    estimator: Estimator,
    clock: Clock,
    params: Params,
    measurements: Measurement,
    prior: Gaussian | None,
    t0: Numbers,
    times: Numbers,
    key: RandomKey,
) -> Trace:
    dtype = float_dtype(measurements.value)
    state = initial(estimator, params, prior, t0, dtype, key)
    times = None if times is None else jnp.asarray(times, dtype)
    screened, refused = screen(measurements, dtype)

    def body(state: State, arrival: tuple[Measurement, Array | None]) -> tuple[Any, tuple]:
        measurement, time = arrival
        moved = arrive(estimator, params, state, measurement, time if clock == "arrival" else None)
        shown = moved.reported
        if time is not None and clock == "validity":
            shown = estimator.predict(params, shown, time)
        mean, cov = estimator.estimate(params, shown)
        return moved.kept, (shown.time, mean, cov, moved.info)

    state, (time, mean, cov, info) = lax.scan(body, state, (screened, times))
    return Trace(time, mean, cov, marked(info, refused), state)


def _filtered_inside(estimator: Estimator, clock: Clock, *inputs: Any) -> Trace:
    """The same as a part of a program that may be differentiated."""
    shared = jax.tree.map(lambda _: False, inputs)
    return with_few_slopes(partial(_filtered_run, estimator, clock), shared)(*inputs)


def _compiled_run(arrivals: int, state: State, key: RandomKey) -> Any:
    """`_filtered_run`, compiled as hard as so many arrivals and such a state deserve."""
    if transformed():
        return _run_inside
    longest = max((x.shape[-1] for x in jax.tree.leaves(state) if x.ndim), default=1)
    if arrivals * max(longest, 100) <= 1e5:
        return _run_short
    # What draws random numbers has many members, and fills vectors.
    return _run_wide if key is not None and arrivals > 100 else _run_small


_STATIC = ("estimator", "clock")
_run_inside = jax.jit(_filtered_inside, static_argnums=(0, 1))
_run_wide = jax.jit(_filtered_run, static_argnames=_STATIC)
_run_small = quick_jit(_filtered_run, _STATIC, QUICK)
_run_short = quick_jit(_filtered_run, _STATIC, QUICKEST)
