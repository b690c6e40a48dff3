"""Filtering as measurements come in: one arrival (`step`), one for each of many tracks
(`step_batch`), the arrivals of a stream one by one (`arrivals`), and a look ahead (`forecast`)."""

from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ewif_jax import checks
from ewif_jax.arrival import arrive, marked, screen
from ewif_jax.every_run import lowest, per_run_flags, ranked, same_runs
from ewif_jax.fast.compiling import QUICKEST, WIDE, quick_jit, transformed
from ewif_jax.fast.layout import Frozen, one_run
from ewif_jax.fast.loops import Loop, over_runs
from ewif_jax.fast.memo import question_of, remembered
from ewif_jax.fast.slopes import with_few_slopes
from ewif_jax.latency import on_time
from ewif_jax.models.components import check_components
from ewif_jax.models.entry import check_covariances_of, check_times
from ewif_jax.models.sensor_range import check_sensor
from ewif_jax.models.steps import check_steps
from ewif_jax.types import (
    Estimator,
    Gaussian,
    Info,
    Measurement,
    Numbers,
    Params,
    PyTree,
    RandomKey,
    State,
)


def step(
    estimator: Estimator, params: Params, state: State, measurement: Measurement
) -> tuple[Any, Info]:
    """The state after one arrival, and its diagnostics: the body of `run` as a streaming call.

    The state moves to the measurement's time unless that is past (then the measurement is late).
    A measurement whose mask is all False changes nothing. One that is not a number (its time, or
    a present component or its square, is NaN or infinite) changes nothing either: `REJECTED`.

    The program is compiled in the first call with an estimator and shapes, and used again from
    then on: keep the estimator, or make it with equal arguments. Inside `jit`, `vmap` and `grad`
    it is a part of that program.

    Args:
        estimator: any `Estimator`.
        params: what its parameters are read from.
        state: from `estimator.init` or an earlier `step`.
        measurement: one arrival: time (), value (m,), sensor (), mask (m,); see `arrivals`.

    Raises:
        ValueError: a known time between two steps of a discrete model; a known sensor that the
            model has not, or components that it has not; known parameters that make no covariances.
    """
    checks.estimator(estimator)
    check_components(estimator.model, measurement, "measurement")
    measurement = on_time(estimator.model, None, params, measurement)
    _check_arrival(estimator, params, state, measurement)
    return _step(estimator, params, state, measurement)


def step_batch(
    estimator: Estimator,
    params: Params,
    state: State,
    measurement: Measurement,
    params_per_run: PyTree = False,
) -> tuple[Any, Info]:
    """`step` for R tracks at once: their states after one arrival each, and its diagnostics.

    A track for which nothing arrived has a mask that is all False, and stays as it is.

    Args:
        estimator: any `Estimator`.
        params: what its parameters are read from; leaves marked in `params_per_run` lead with R.
        state: the states of R tracks, every leaf (R, ...): of `jax.vmap(estimator.init)`, the
            `final_state` of `run_batch`, or an earlier `step_batch`.
        measurement: time (R,), value (R, m), sensor (R,), mask (R, m); time, sensor and mask
            without R where all tracks share them.
        params_per_run: True, False, or a pytree prefix of `params` of these.

    Returns:
        The states and `Info` with leaves (R, ...).

    Raises:
        ValueError: arguments whose numbers of tracks differ; what `step` refuses, of any track.
    """
    checks.estimator(estimator)
    checks.require(
        isinstance(measurement, Measurement),
        "measurement",
        "a Measurement",
        type(measurement).__name__,
    )
    checks.shape("measurement.value", measurement.value, ("R", "m"))
    runs = np.shape(measurement.value)[0]
    flags = per_run_flags("params", params_per_run, params)
    same_runs("params", params, flags, runs)
    every = jax.tree.map(lambda _: True, state)
    same_runs("state", state, every, runs)
    marks = ranked(measurement, (0, 1, 0, 1))
    same_runs("measurement", measurement, marks, runs)
    measurement = on_time(estimator.model, None, params, measurement, flags)
    marks = ranked(measurement, (0, 1, 0, 1))
    _check_steps_of_tracks(estimator, state, measurement)
    check_components(estimator.model, measurement, "measurement")
    # Tracks with the lowest parameters are where a variance would be negative first; to check all R
    # one by one would take longer than the step.
    for k in {0, *lowest(params, flags)}:
        own = one_run((params, measurement), (flags, marks), k)
        _check_arrival(
            estimator, own[0], state, own[1]._replace(sensor=_largest_sensor(measurement))
        )
    return _step_batch(
        estimator, params, state, measurement, Frozen((flags, every, marks)), transformed()
    )


def forecast(
    estimator: Estimator,
    params: Params,
    state: State,
    times: Numbers,
    params_per_run: PyTree = False,
) -> Gaussian:
    """What a filter expects at `times`: means (T, n) and covariances (T, n, n); of R tracks at once
    means (R, T, n) and covariances (R, T, n, n).

    Each time is predicted straight from the state, which stays as it is: also the estimate at *now*
    while nothing arrives. Estimators that do not move back are NaN at a time before the state's.

    Args:
        estimator: any `Estimator`.
        params: what its parameters are read from; leaves marked in `params_per_run` lead with R.
        state: from `estimator.init`, `step`, or the `final_state` of `run`; or the states of R
            tracks, every leaf (R, ...), of `step_batch` or `run_batch`.
        times: (T,) in seconds, in any order; or (R, T), each track's own.
        params_per_run: True, False, or a pytree prefix of `params` of these.

    Raises:
        ValueError: times of another shape, or not finite; arguments whose numbers of tracks differ;
            known times between two steps of a discrete model.
    """
    checks.estimator(estimator)
    many = np.ndim(state.time) == 1
    own_times = many and np.ndim(times) == 2
    checks.shape("times", times, ("R", "T") if own_times else ("T",))
    checks.finite("times", times)
    dtype, model = state.time.dtype, estimator.model
    steps = None if model is None else model.steps
    if not many:
        check_steps(steps, times, state.time, dtype, "times", False)
        return _forecast(estimator, params, state, jnp.asarray(times, dtype))
    runs = np.shape(state.time)[0]
    flags = per_run_flags("params", params_per_run, params)
    same_runs("params", params, flags, runs)
    same_runs("state", state, jax.tree.map(lambda _: True, state), runs)
    same_runs("times", times, own_times, runs)
    start = checks.concrete_value(state.time)
    if start is not None and checks.concrete_value(times) is not None:
        check_steps(
            steps,
            np.broadcast_to(times, (runs, np.shape(times)[-1])),
            start[:, None],
            dtype,
            "times",
            False,
        )
    return _forecast_tracks(
        estimator, params, state, jnp.asarray(times, dtype), Frozen((flags, own_times))
    )


def arrivals(measurements: Measurement) -> Iterator[Measurement]:
    """The arrivals of a stream (T, ...) one by one, for `step`; taking one costs a microsecond.

    A batch of streams whose time leads, (T, R, ...), gives arrivals for `step_batch`.
    """
    time, value, sensor, mask = map(np.asarray, measurements)
    for k in range(len(time)):
        yield Measurement(time[k], value[k], sensor[k], mask[k])


def _largest_sensor(measurement: Measurement) -> Any:
    index = checks.concrete_value(measurement.sensor)
    return measurement.sensor if index is None else np.int32(index.max(initial=0))


def _check_steps_of_tracks(estimator: Estimator, state: State, measurement: Measurement) -> None:
    """Refuses known times that are not whole steps from the time of their own track; where nothing
    arrived there is no time."""
    steps = None if estimator.model is None else estimator.model.steps
    given = (measurement.time, measurement.mask, state.time)
    time, mask, start = map(checks.concrete_value, given)
    if steps is None or time is None or mask is None or start is None:
        return
    stamps = np.where(mask.any(-1), time, start)
    check_steps(steps, stamps[:, None], start[:, None], state.time.dtype, "measurement.time")


def _check_arrival(
    estimator: Estimator, params: Params, state: State, measurement: Measurement
) -> None:
    """Refuses what is known to be wrong with one arrival; of parameters once."""
    model = estimator.model
    if model is None:
        return
    dtype = state.time.dtype
    if model.steps is not None and np.ndim(state.time) == 0:
        check_times(model, measurement, state.time, dtype)
    index = checks.concrete_value(measurement.sensor)
    if index is None:
        return
    if model.sensors is None and index > 0 and model.linear is None:
        shape = jax.eval_shape(estimator.estimate, params, state).mean
        check_sensor(model, params, np.zeros(shape.shape, dtype), index, measurement.time)
    else:
        check_sensor(model, params, None, index, measurement.time)
    question = question_of(_check_arrival, estimator, params, int(index))
    if question is not None:

        def look() -> bool:
            check_covariances_of(model, params, np.zeros(()), np.zeros(()), index)
            return True

        remembered(question, look)


def _stepped_runs(
    estimator: Estimator, params: Params, state: State, measurement: Measurement
) -> tuple[Any, Info]:
    screened, refused = screen(measurement, state.time.dtype)
    arrival = arrive(estimator, params, state, screened)
    return arrival.kept, marked(arrival.info, refused)


def _forecasts_at(estimator: Estimator, params: Params, state: State, times: Array) -> Gaussian:
    def predicted(time: Array) -> Gaussian:
        return estimator.estimate(params, estimator.predict(params, state, time))

    return jax.vmap(predicted)(times)


def _forecasts_of_tracks(
    estimator: Estimator, params: Params, states: State, times: Array, flags: Frozen
) -> Gaussian:
    params_f, own_times = flags.tree
    axes = jax.tree.map(lambda f: 0 if f else None, (params_f, own_times))

    def of_track(params: Params, state: State, times: Array) -> Gaussian:
        return _forecasts_at(estimator, params, state, times)

    return jax.vmap(of_track, in_axes=(axes[0], 0, axes[1]))(params, states, times)


_forecast_tracks = quick_jit(_forecasts_of_tracks, ("estimator", "flags"), WIDE)
_forecast = quick_jit(_forecasts_at, ("estimator",), QUICKEST)
_step = quick_jit(_stepped_runs, ("estimator",), QUICKEST)


def _stepped_batch(
    estimator: Estimator,
    params: Params,
    states: State,
    measurement: Measurement,
    flags: Frozen,
    is_part: bool,
) -> tuple[Any, Info]:
    params_f, states_f, marks = flags.tree
    dtype = states.time.dtype
    measurement = measurement._replace(
        time=jnp.asarray(measurement.time, dtype), value=jnp.asarray(measurement.value, dtype)
    )

    def start(params: Params, state: State, key: RandomKey) -> Any:
        del params, key
        return state

    def one_step(params: Params, state: State, arrived: PyTree) -> tuple[Any, Any]:
        return _stepped_runs(estimator, params, state, arrived[0])

    def all_tracks(params: Params, states: State, measurement: Measurement) -> tuple[Any, Any]:
        # One arrival is a stream of length 1: so the loop of `run_batch`, with its groups and
        # shared parts, does the step of many tracks too.
        alone = jax.tree.map(
            lambda x, f: x[:, None] if f else jnp.asarray(x)[None], measurement, marks
        )
        inputs = params, alone, states, None, None, None
        loop = Loop(start, one_step)
        return over_runs(
            loop, estimator.estimate, inputs, (params_f, marks, states_f, None, None, None)
        )

    if is_part:
        all_tracks = with_few_slopes(all_tracks, (params_f, states_f, marks))
    info, kept = all_tracks(params, states, measurement)
    return kept, jax.tree.map(_only_run, info)


def _only_run(x: Array) -> Array:
    return x[:, 0]


_step_batch = quick_jit(_stepped_batch, ("estimator", "flags", "is_part"), WIDE)
