"""Exact use of late measurements: put each in its place among the last ones and filter again."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array, lax

from ewif_jax import checks
from ewif_jax.arrival import arrive
from ewif_jax.kernels.trees import choose
from ewif_jax.recipe import from_recipe
from ewif_jax.recursions.contract import Recursion, estimator_from
from ewif_jax.recursions.partial_use import partly
from ewif_jax.types import (
    Estimator,
    Gaussian,
    Info,
    Measurement,
    Numbers,
    Params,
    PyTree,
    RandomKey,
)


class ReplayState(NamedTuple):
    """time (); current: the estimator's state with everything; base: its state before the buffered
    measurements; buffer: L measurements sorted by time, values padded; evidence (): their joint log
    likelihood given the base; shares (L+1,): how much of each of them and of the next one is used,
    or None where that is all."""

    time: Array
    current: Any
    base: Any
    buffer: Measurement
    evidence: Array
    shares: Array | None = None


@from_recipe
def replay(estimator: Estimator, lag: int, *, width: int = 8) -> Estimator:
    """The estimator as it would be had every measurement come in order of validity time.

    The last `lag` measurements are kept, sorted, with the state before them. A new measurement is
    put in its place (after those of the same time) and the buffer is filtered again, which costs
    `lag` + 1 steps of the estimator for every measurement, late or not. This is the exact
    reference for every other method, for estimators of any kind: a stochastic one repeats its
    random numbers, because its key is part of the state before the buffer.

    Args:
        estimator: any `Estimator`.
        lag: how many measurements are kept, >= 1. One older than the newest that has left the
            buffer, or than t0, is `TOO_LATE`.
        width: room for the components of one measurement.

    `Info.innovation` and `innovation_cov` are those of the measurement in its place, given what is
    older. `log_likelihood` is that given everything that arrived before: the change of the joint
    log likelihood.

    Reduces to: the estimator run on the stream sorted by validity time.

    Raises:
        ValueError: lag < 1; a measurement of more than `width` components.
    """
    checks.estimator(estimator)
    lag = checks.whole("lag", lag, 1)
    width = checks.whole("width", width, 1)

    def start(params: Params, prior: Gaussian | None, t0: Numbers, key: RandomKey) -> ReplayState:
        first = estimator.init(params, prior, t0, key)
        time = first.time
        nothing = Measurement(
            jnp.full(lag, time, time.dtype),
            jnp.zeros((lag, width), time.dtype),
            jnp.zeros(lag, jnp.int32),
            jnp.zeros((lag, width), bool),
        )
        return ReplayState(time, first, first, nothing, jnp.zeros((), time.dtype))

    def move(params: Params, state: ReplayState, time: Array) -> ReplayState:
        current = estimator.predict(params, state.current, time)
        return state._replace(time=current.time, current=current)

    def is_after_base(params: Params, state: ReplayState, time: Array) -> Array:
        del params
        return time >= state.base.time

    def measure(
        params: Params, state: ReplayState, measurement: Measurement
    ) -> tuple[ReplayState, Info]:
        size = jnp.shape(measurement.value)[0]
        checks.require(size <= width, "width", f"room for {size} components", width)
        if (
            checks.concrete_value(measurement.sensor) is not None
        ):  # in the buffer it is not known any more
            jax.eval_shape(lambda: estimator.update(params, state.current, measurement))
        shares = state.shares
        stored, share = (None, None) if shares is None else (shares[:-1], shares[-1])
        sorted_in, place = _inserted_in_order(
            (state.buffer, stored), (_padded_measurement(measurement, width), share)
        )

        def filtered(at: Numbers, entry: tuple[Measurement, Array | None]) -> tuple[Any, Info]:
            measured, share = entry
            cut = measured._replace(value=measured.value[:size], mask=measured.mask[:size])
            method = estimator if share is None else partly(estimator, share)
            moved = arrive(method, params, at, cut)
            return moved.kept, moved.info

        oldest, rest = (jax.tree.map(lambda x, k=k: x[k], sorted_in) for k in (0, slice(1, None)))
        base, first = filtered(state.base, oldest)
        last, others = lax.scan(filtered, base, rest)
        ahead = state.time > last.time
        current = choose(ahead, estimator.predict(params, last, state.time), last)
        infos = jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), first, others)
        total = jnp.sum(infos.log_likelihood).astype(state.evidence.dtype)
        info = jax.tree.map(lambda x: x[place], infos)
        # The chain rule in order of arrival: log p(z | all that came) is the joint log likelihood
        # with z minus the one without it. The sum of what `Info` reports is then the joint density
        # of the stream, in whatever order it came.
        info = info._replace(log_likelihood=total - state.evidence)
        # The oldest measurement moves into the base: its density leaves the buffer's joint one.
        evidence = total - infos.log_likelihood[0]
        buffer, stored = rest
        shares = None if stored is None else jnp.append(stored, jnp.ones_like(stored[:1]))
        return ReplayState(state.time, current, base, buffer, evidence, shares), info

    def estimate(params: Params, state: ReplayState) -> Gaussian:
        return estimator.estimate(params, state.current)

    method = Recursion(
        "replay", start, move, measure, estimate, is_after_base, model=estimator.model
    )
    # What it wraps checks the prior and the key, and may predict earlier times.
    method = method._replace(moves_back=True, starts_from_nothing=True, remembers=True)
    return estimator_from(method._replace(model=estimator.model))


def _padded_measurement(measurement: Measurement, width: int) -> Measurement:
    room = (0, width - measurement.value.shape[0])
    return measurement._replace(
        value=jnp.pad(measurement.value, room), mask=jnp.pad(measurement.mask, room)
    )


def _inserted_in_order(
    buffer: tuple[Measurement, PyTree], new: tuple[Measurement, PyTree]
) -> tuple[Any, Array]:
    """The buffer with `new` after everything not newer, and its place."""
    times = buffer[0].time
    place = jnp.sum(times <= new[0].time)
    index = jnp.arange(times.shape[0] + 1)
    # Shifted by index arithmetic, not by a sort: `place` counts ties as older, so that measurements
    # of one time stay in order of arrival.
    source = jnp.where(index < place, index, index - 1)

    def inserted(table: Array, row: Array) -> Array:
        here = (index == place).reshape(-1, *[1] * (table.ndim - 1))
        return jnp.where(here, row[None], table[jnp.clip(source, 0, table.shape[0] - 1)])

    return jax.tree.map(inserted, buffer, new), place
