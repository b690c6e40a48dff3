"""One unit of work: all methods on one chunk of runs at one point of the grid, on one device."""

from collections.abc import Mapping
from functools import cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ewif_jax.batch import Observer, Step, run_batch
from ewif_jax.fast.layout import equal_part
from ewif_jax.lab import methods as lines
from ewif_jax.lab.design import Design
from ewif_jax.lab.timing import timed
from ewif_jax.monte_carlo import Simulation, run_keys, simulate_batch, step_sums
from ewif_jax.scores import Score, average, score_of
from ewif_jax.streams import float_dtype
from ewif_jax.types import DTypeLike, Gaussian, Numbers, Params, PyTree, Status

Arrays = dict[str, np.ndarray]
STATUSES = len(Status)


class SeenArrival(NamedTuple):
    """What a score sees of an arrival besides the estimate: truth (k,), mask (m,), and a stand-in
    for an estimate that there is not."""

    truth: Any
    mask: Any
    instead: Any


def computed(
    design: Design, point: Mapping[str, float], chunk: int, tuned: Mapping[str, Params]
) -> Arrays:
    """What the methods (M, in their order) make of a chunk of runs (R).

    By metric: `score/name` (M, R) averages over the rows that count, `final/name` (M, R) of the
    last row, `missing/name` (M,) rows that count and have no score; with limits `converged/name`
    (M, R) seconds and `lost/name` (M, R); over time `STEP_SUMS` by name (M, T).
    `status` (M, 5) counts of what became of measurements, `without` (M,) rows without an estimate,
    `rows` (R,) that count, `time` (T,); `seconds` (M,) of filtering and `simulating` (), without
    compiling.
    """
    real = design.runs_of(chunk)
    index = equal_part(design.runs, design.chunk, chunk)
    keys, own_keys = run_keys(design.key, index)
    with timed() as simulating:
        simulation = simulate_batch(design.scenario, keys, design.world_at(point))
        simulation = jax.block_until_ready(simulation)
    rows = _counted_rows(simulation, design)
    found: list[Arrays] = []
    for name, method in design.methods.items():
        params = tuned.get(name, lines.at_point(method.params, point))
        with timed() as filtering:
            part = jax.device_get(
                _one_method(design, name, params, simulation, own_keys, rows, real)
            )
        found.append({**part, "seconds": np.asarray(filtering.run)})
    joined = {name: np.stack([_real_runs(name, x[name], real) for x in found]) for name in found[0]}
    times = simulation.measurements.time if simulation.times is None else simulation.times
    times = np.asarray(times, float)
    times = np.maximum.accumulate(times, axis=-1)
    return {
        **joined,
        "rows": np.broadcast_to(np.asarray(rows).sum(-1), (design.chunk,))[:real],
        "time": times if times.ndim == 1 else times[:real].mean(0),
        "simulating": np.asarray(simulating.run),
    }


RUNWISE = ("score", "final", "converged", "lost")
STEP_SUMS = ("count", "mean", "apart", "squares")
"""what `step_sums` gives of each step"""
SUMMED = ("missing", "status", "without")


def _real_runs(name: str, x: np.ndarray, real: int) -> np.ndarray:
    """Without the repetitions that fill a chunk."""
    kind = name.split("/")[0]
    return x[:real] if kind in RUNWISE else x[:real].sum(0) if kind in SUMMED else x


def _counted_rows(simulation: Simulation, design: Design) -> Array:
    """(T,) or (R, T), which rows count: the same for all methods."""
    stream = simulation.measurements
    if design.warm_up is not None:
        times = stream.time if simulation.times is None else simulation.times
        newest = jnp.maximum(jax.lax.cummax(jnp.asarray(times), axis=jnp.ndim(times) - 1), 0)
        start = jnp.asarray(design.scenario.t0, newest.dtype)
        return newest - start >= design.warm_up
    components = jnp.asarray(stream.mask).sum(-1)
    return jnp.cumsum(components, -1) >= design.unknowns


def _one_method(
    design: Design,
    name: str,
    params: Params,
    simulation: Simulation,
    keys: Array,
    rows: Array,
    real: int,
) -> Any:
    method, stream = design.methods[name], simulation.measurements
    told = method.told_by(design.scenario)
    dtype = float_dtype(stream.value)
    instead = _stand_in(design, design.sizes[name], dtype)
    steps = stream.value.shape[1]
    truth = jnp.asarray(simulation.truth).astype(dtype)
    over_steps = jax.tree.map(lambda x: jnp.broadcast_to(x, (steps, *x.shape)), instead)
    seen = run_batch(
        method.estimator,
        params,
        stream,
        prior=told.prior,
        t0=told.t0,
        times=simulation.times,
        clock=told.clock,
        key=keys,
        observe=_score_observer(tuple(design.metrics.items())),
        context=SeenArrival(truth, jnp.asarray(stream.mask), over_steps),
        context_per_run=SeenArrival(truth.ndim == 3, stream.mask.ndim == 3, False),
        devices=1,
    )
    times = stream.time if simulation.times is None else simulation.times
    limits = tuple((name, x.converged, x.lost) for name, x in design.limits.items())
    return _reduced_scores(
        seen, rows, jnp.asarray(times), design.scenario.t0, real, limits, design.over_time
    )


def _stand_in(design: Design, size: int, dtype: DTypeLike) -> Gaussian:
    """What everybody knows at the start, in a state of `size` numbers; NaN if nothing."""
    prior = design.scenario.prior
    if prior is None:
        return Gaussian(jnp.full(size, jnp.nan, dtype), jnp.full((size, size), jnp.nan, dtype))
    mean, cov = np.zeros(size), np.eye(size)
    count = min(size, np.shape(prior.mean)[0])
    mean[:count] = np.asarray(prior.mean)[:count]
    cov[:count, :count] = np.asarray(prior.cov)[:count, :count]
    return Gaussian(jnp.asarray(mean, dtype), jnp.asarray(cov, dtype))


@cache
def _score_observer(metrics: tuple[tuple[str, Score], ...]) -> Observer:
    """Scores by name, what became of the measurement, and whether there was an estimate; one
    object for equal metrics, so that nothing is compiled again."""

    def observe(step: Step, seen: SeenArrival) -> dict[str, Any]:
        is_absent = jnp.any(jnp.isnan(step.mean))
        shown = step._replace(
            mean=jnp.where(is_absent, seen.instead.mean, step.mean),
            cov=jnp.where(is_absent, seen.instead.cov, step.cov),
        )
        scores = {
            name: score_of(name, score, shown, seen.truth, seen.mask) for name, score in metrics
        }
        return {"scores": scores, "status": step.info.status, "absent": is_absent}

    return observe


@partial(jax.jit, static_argnames=("limits", "over_time"))
def _reduced_scores(
    seen: PyTree,
    rows: Array,
    times: Array,
    t0: Numbers,
    real: int,
    limits: tuple[tuple[str, float | None, float | None], ...],
    over_time: bool,
) -> dict[str, Array]:
    """What is kept of scores (R, T)."""
    found: dict[str, Array] = {}
    shape = seen["status"].shape
    is_real = jnp.arange(shape[0]) < real
    rows = jnp.broadcast_to(rows, shape)
    times = jax.lax.cummax(jnp.broadcast_to(times, shape), axis=1)
    for name, score in seen["scores"].items():
        counted = jnp.where(rows, score, jnp.nan)
        found[f"score/{name}"] = average(counted, 1)
        found[f"final/{name}"] = score[:, -1]
        found[f"missing/{name}"] = jnp.sum(rows & jnp.isnan(score), 1)
        if over_time:
            score = jnp.where(is_real[:, None], score, jnp.nan)
            is_score = ~jnp.isnan(score)
            for kind, x in zip(STEP_SUMS, step_sums(score, is_score), strict=True):
                found[f"{kind}/{name}"] = x
    for name, converged, lost in limits:
        score = seen["scores"][name]
        if converged is not None:
            good = score <= converged  # NaN is not
            # A running minimum from the end: 1 from the first row on after which the score never
            # exceeds the limit again.
            stays = jnp.flip(jax.lax.cummin(jnp.flip(good.astype(jnp.int32), 1), axis=1), 1)
            first = jnp.argmax(stays, 1)
            since = jnp.take_along_axis(times, first[:, None], 1)[:, 0] - t0
            found[f"converged/{name}"] = jnp.where(stays[:, -1] > 0, since, jnp.inf)
        if lost is not None:
            found[f"lost/{name}"] = ~(score[:, -1] <= lost)
    kinds = jnp.arange(STATUSES)
    found["status"] = jnp.sum(seen["status"][..., None] == kinds[None, None], 1)
    found["without"] = jnp.sum(rows & seen["absent"], 1)
    return found
