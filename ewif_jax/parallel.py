"""The EWIF over one long series, parallel in time."""

from collections.abc import Callable
from functools import partial
from math import isqrt
from typing import Any, Literal

import jax
import jax.numpy as jnp
from jax import Array, lax

from ewif_jax import checks
from ewif_jax.arrival import arrive, initial
from ewif_jax.estimators.ewif import ewif, growth
from ewif_jax.latency import on_time
from ewif_jax.models.components import check_components
from ewif_jax.models.linearise import need_known_noise
from ewif_jax.models.model import Model
from ewif_jax.recursions import information as form
from ewif_jax.recursions import passage as way
from ewif_jax.recursions.information import InformationState
from ewif_jax.recursions.passage import Passage
from ewif_jax.streams import cast, float_dtype, given
from ewif_jax.trial import validated
from ewif_jax.types import Gaussian, Measurement, Numbers, Parameter, Params, Trace

Method = Literal["blocked", "associative"]
Stretch = tuple[InformationState, Passage]


def run_parallel(
    model: Model,
    params: Params,
    measurements: Measurement,
    *,
    tau: Parameter = None,
    weight: Callable[..., Array] | None = None,
    prior: Gaussian | None,
    t0: Numbers,
    times: Numbers = None,
    method: Method = "blocked",
    block: int | None = None,
) -> Trace:
    r"""What `run` gives for `ewif`, computed for all parts of the series at once.

    .. math::
        P_k^{-1} = \sum_{l \le k} W_{l,k}^2 A_{l,k}' H_l' R_l^{-1} H_l A_{l,k} \quad (9)

    Without process noise (Shulami & Sigalov, eqs. (18)-(19)) the information is a decayed sum over
    the arrivals. The series is cut into blocks; all blocks are filtered at once from nothing, the
    information carried into each block follows from these sums without any inverse, and all blocks
    are filtered again from what was carried in. Irregular times, masks, late measurements, inputs
    and gradients are those of `ewif`. On one CPU core `run` takes no longer after `prepare_cpu`.

    Args:
        model, tau, weight: as in `ewif`.
        params, measurements, prior, t0, times: as in `run`.
        method: how information is carried across the blocks. "blocked": one block after the other
            (CPU). "associative": a parallel prefix sum (accelerators).
        block: arrivals per block; default the square root of their number, or 1 for "associative".

    Returns:
        The `Trace` of `run`, to rounding. With "associative" and very short blocks float32 loses
        digits where the state is far from zero: take longer blocks or float64 there.

    Raises:
        ValueError: as `ewif` and `run`; an unknown method; block < 1.

    Reduces to: `run(ewif(model, tau), ...)`.
    """
    is_method = method in ("blocked", "associative")
    checks.require(is_method, "method", "'blocked' or 'associative'", repr(method))
    estimator = ewif(model, tau, weight=weight)
    need_known_noise(model, "run_parallel")
    params, measurements, prior, t0, times = given(params, measurements, prior, t0, times)
    check_components(model, measurements)
    measurements = on_time(model, None, params, measurements)
    validated(estimator, params, measurements, prior, t0, times, "validity", None)
    measurements = cast(measurements, float_dtype(measurements.value))
    steps = measurements.value.shape[0]
    if block is None:
        block = isqrt(steps - 1) + 1 if method == "blocked" else 1
    block = min(checks.whole("block", block, 1), steps)
    by_params, constant = (tau, None) if callable(tau) else (None, tau)
    return _run_parallel(
        model, by_params, weight, method, block, params, constant, measurements, prior, t0, times
    )


@partial(jax.jit, static_argnames=("model", "by_params", "weight", "method", "block"))
def _run_parallel(
    model: Model,
    by_params: Callable[..., Array] | None,
    weight: Callable[..., Array] | None,
    method: Method,
    block: int,
    params: Params,
    constant: Any,
    measurements: Measurement,
    prior: Gaussian | None,
    t0: Numbers,
    times: Numbers,
) -> Trace:
    tau = constant if by_params is None else by_params
    estimator = ewif(model, tau, weight=weight)
    steps, dtype = measurements.value.shape[0], measurements.value.dtype
    start = initial(estimator, params, prior, t0, dtype, None)
    times = None if times is None else jnp.asarray(times, dtype)
    blocks = -(-steps // block)
    padded = jax.tree.map(partial(_padded_series, to=blocks * block), (measurements, times))
    absent = (jnp.arange(blocks * block) >= steps)[:, None]
    measurements = padded[0]._replace(mask=padded[0].mask & ~absent)
    # Blocks are the last axis: they are a batch, and kernels of small matrices take batches there
    # (`fast/README.md`).
    cut = partial(_blocks_last, blocks=blocks)
    arrivals, reports = jax.tree.map(cut, (measurements, padded[1]))

    growing = growth(tau, weight)

    def from_nothing(time: Array) -> Stretch:
        return form.start(model, params, None, time), way.standstill(start.mean.shape[0], dtype)

    def lengthen(stretch: Stretch, measurement: Measurement) -> Stretch:
        state, passed = stretch
        kept = arrive(estimator, params, state, measurement).kept
        leg = way.passage(model, params, growing, state.time, kept.time, dtype)
        return kept, way.both_passages(passed, leg)

    def after(state: InformationState, stretch: Stretch) -> InformationState:
        own, passed = stretch
        return form.recentred(form.joined(way.carried_over(state, passed, own.time), own))

    def filtered(state: InformationState, arrival: tuple[Measurement, Array]) -> tuple[Any, Any]:
        measurement, time = arrival
        moved = arrive(estimator, params, state, measurement)
        shown = moved.reported
        if time is not None:
            shown = estimator.predict(params, shown, time)
        mean, cov = estimator.estimate(params, shown)
        return moved.kept, (shown.time, mean, cov, moved.info)

    def all_blocks(fn: Callable[..., Any]) -> Callable[..., Any]:
        return jax.vmap(fn, in_axes=-1, out_axes=-1)

    seen = jnp.where(jnp.any(measurements.mask, 1), measurements.time, start.time)
    # Each block begins at the time that the filter will have reached there, the newest so far: then
    # its first arrivals are late in it exactly where they are late in the sequence.
    newest = lax.cummax(jnp.maximum(seen, start.time))[block - 1 : -1 : block]
    empty = all_blocks(from_nothing)(jnp.concatenate([start.time[None], newest]))
    # Twice the work of `run`, in sqrt(T) rounds of sqrt(T) blocks each: the first pass finds what
    # every block adds, the second filters from what is carried in.
    stretches, _ = lax.scan(lambda s, m: (all_blocks(lengthen)(s, m), None), empty, arrivals)
    stretches = jax.tree.map(_leading_axis, stretches)
    carried_in = jax.tree.map(_trailing_axis, _carried_in(start, stretches, after, method))
    final, outputs = lax.scan(all_blocks(filtered), carried_in, (arrivals, reports))
    time, mean, cov, info = jax.tree.map(lambda x: _joined_blocks(x)[:steps], outputs)
    return Trace(time, mean, cov, info, jax.tree.map(lambda x: x[..., -1], final))


def _carried_in(
    start: InformationState, stretches: Stretch, after: Callable[..., Any], method: Method
) -> InformationState:
    """What is known before each block, blocks first."""
    if method == "blocked":
        return lax.scan(lambda state, s: (after(state, s), state), start, stretches)[1]

    def together(first: Stretch, second: Stretch) -> Stretch:
        return after(first[0], second), way.both_passages(first[1], second[1])

    def pairwise(firsts: Stretch, seconds: Stretch) -> Stretch:
        none = seconds[0].time.size == 0  # the prefix sum of two asks for this
        return seconds if none else jax.vmap(together)(firsts, seconds)

    still = way.standstill(start.mean.shape[0], start.mean.dtype)
    nothing_before = start, still
    links = jax.tree.map(lambda a, b: jnp.concatenate([a[None], b[:-1]]), nothing_before, stretches)
    return lax.associative_scan(pairwise, links)[0]


def _padded_series(x: Array, to: int) -> Array:
    """(T, ...) lengthened to (to, ...) with its last entry."""
    last = jnp.broadcast_to(x[-1:], (to - x.shape[0], *x.shape[1:]))
    return jnp.concatenate([jnp.asarray(x), last])


def _blocks_last(x: Array, blocks: int) -> Array:
    """(blocks L, ...) as (L, ..., blocks)."""
    return _trailing_axis(x.reshape(blocks, -1, *x.shape[1:]))


def _joined_blocks(x: Array) -> Array:
    """(L, ..., blocks) as (blocks L, ...)."""
    first = _leading_axis(x)
    return first.reshape(-1, *first.shape[2:])


def _trailing_axis(x: Array) -> Array:
    return jnp.moveaxis(x, 0, -1)


def _leading_axis(x: Array) -> Array:
    return jnp.moveaxis(x, -1, 0)
