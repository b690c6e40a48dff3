"""Filtering a stream by any method, and what the result is worth."""

import time as clock
from collections.abc import Sequence
from functools import lru_cache, partial
from typing import Any, NamedTuple

import jax
import numpy as np

import ewif_jax as ej
from benchmarks.oosm.methods import Ours
from benchmarks.oosm.others import Build, Stepwise
from benchmarks.oosm.streams import Stream

LIVE = 30
"""Arrivals of one run that are taken one at a time, to time them."""


class Found(NamedTuple):
    """mean (R, T, 4) and cov (R, T, 4, 4) at the newest time after each arrival. batch_us and
    live_us: microseconds an arrival takes, of a whole recorded track in one program, and one at a
    time from Python. compile_s: seconds to trace and compile the program of a whole track. numbers:
    floating-point numbers kept."""

    mean: np.ndarray
    cov: np.ndarray
    batch_us: float
    live_us: float
    compile_s: float
    numbers: float


def found_by(method: Ours | Build, stream: Stream, live: bool = False) -> Found:
    """What a method says of a stream, one run after another; `live`: see `by_ours`."""
    return by_ours(method, stream, live) if isinstance(method, Ours) else by_steps(method, stream)


def by_ours(method: Ours, stream: Stream, live: bool) -> Found:
    """Ours: `run` on each track; with `live` also `step`."""
    tracks = [_measurements(method, stream, run) for run in range(len(stream.time))]
    prior = ej.Gaussian(stream.world.mean, stream.world.cov)
    given = (method.params, tracks[0], prior, jax.random.key(0))
    program, seconds = program_of(method.estimator, stream.time.shape[1])(*given)
    results, times = [], []
    for run, track in enumerate(tracks):
        key = jax.random.key(run)
        start = clock.perf_counter()
        results.append(jax.block_until_ready(program(method.params, track, prior, key)))
        times.append(clock.perf_counter() - start)
    mean, cov = (np.stack([np.asarray(result[k]) for result in results]) for k in (0, 1))
    a_row = 1e6 / stream.time.shape[1]
    live_us = _live_us(method, tracks[0], prior) if live else np.nan
    kept = ej.storage(method.estimator, 4, params=method.params).numbers
    return Found(mean, cov, float(np.median(times)) * a_row, live_us, seconds, kept)


def by_steps(build: Build, stream: Stream) -> Found:
    """Of others: one arrival after the other."""
    runs, steps = stream.time.shape
    mean, cov = np.full((runs, steps, 4), np.nan), np.full((runs, steps, 4, 4), np.nan)
    times, kept = [], np.nan
    for run in range(runs):
        method: Stepwise = build(stream.world)
        rows = np.flatnonzero(stream.there[run])
        start = clock.perf_counter()
        for k in rows:
            seen = (stream.now[run, k], stream.time[run, k], stream.value[run, k])
            mean[run, k], cov[run, k] = method.arrive(*seen)
        times.append((clock.perf_counter() - start) / max(len(rows), 1))
        if hasattr(method, "numbers"):
            kept = float(method.numbers())
    return Found(mean, cov, np.nan, 1e6 * float(np.median(times)), np.nan, kept)


def best_of(candidates: Sequence[Any], training: Stream) -> Any:
    """The candidate with the least error on other runs."""
    if len(candidates) == 1:
        return candidates[0]
    errors = [
        root_mean_square(position_error(found_by(one, training).mean, training.truth), training)[0]
        for one in candidates
    ]
    return candidates[int(np.nanargmin(errors))]


def scored(found: Found, exact: Found, stream: Stream) -> dict[str, float]:
    """A row of the table.

    rmse: of the position, m, over all arrivals and runs; off: the same against the exact answer;
    each with its standard error over runs. nees: mean of the squared error of the state in units of
    its covariance, ideally 4, with its standard error; inside: share of the arrivals at which its
    mean over runs is in the 95 % band of a consistent filter.
    """
    rmse, rmse_error = root_mean_square(position_error(found.mean, stream.truth), stream)
    off, off_error = root_mean_square(position_error(found.mean, exact.mean), stream)
    nees = normalised(found, stream.truth)
    by_run = mean_by_run(nees, stream)
    return {
        "rmse": rmse,
        "rmse_error": rmse_error,
        "off": off,
        "off_error": off_error,
        "nees": float(by_run.mean()),
        "nees_error": float(by_run.std(ddof=1) / np.sqrt(len(by_run))),
        "inside": share_inside(np.where(stream.there, nees, np.nan)),
        "batch_us": found.batch_us,
        "live_us": found.live_us,
        "compile_s": found.compile_s,
        "numbers": found.numbers,
    }


def position_error(mean: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Squared distance (R, T) of positions."""
    return np.square(mean[..., :2] - truth[..., :2]).sum(-1)


def root_mean_square(squares: np.ndarray, stream: Stream) -> tuple[float, float]:
    """Root of the mean over what arrived, and its standard error over runs."""
    by_run = mean_by_run(squares, stream)
    root = float(np.sqrt(by_run.mean()))
    spread = float(by_run.std(ddof=1) / np.sqrt(len(by_run)))
    return root, spread / (2 * root) if root > 0 else 0.0


def mean_by_run(x: np.ndarray, stream: Stream) -> np.ndarray:
    """(R,) over what arrived; NaN where one of these is."""
    return np.where(stream.there, x, 0).sum(1) / stream.there.sum(1)


def normalised(found: Found, truth: np.ndarray) -> np.ndarray:
    """e' P^-1 e (R, T); NaN where there is no such number."""
    error = found.mean - truth
    good = np.isfinite(error).all(-1) & np.isfinite(found.cov).all((-1, -2))
    variances, axes = np.linalg.eigh(np.where(good[..., None, None], found.cov, np.eye(4)))
    # Particles that have collapsed have no variance at all: what they are off by is then very many
    # standard deviations, and still a number.
    least = np.finfo(float).eps * variances.max(-1, keepdims=True) + 1e-12
    along = np.einsum("...ij,...i->...j", axes, np.where(good[..., None], error, 0))
    return np.where(good, (along**2 / np.maximum(variances, least)).sum(-1), np.nan)


def share_inside(nees: np.ndarray) -> float:
    """Of the arrivals (columns) seen in at least two runs, the share at which the mean over these
    is in their band; NaN where nothing is known."""
    counts = np.isfinite(nees).sum(0)
    inside = []
    for column, count in zip(nees.T, counts, strict=True):
        if count > 1:
            low, high = ej.analysis.chi2_band(4, int(count))
            inside.append(low <= np.nanmean(column) <= high)
    return float(np.mean(inside)) if inside else float("nan")


def _measurements(method: Ours, stream: Stream, run: int) -> ej.Measurement:
    label = stream.label[run] * (method.sees_labels and stream.world.outlier > 0)
    mask = np.repeat(stream.there[run][:, None], 2, 1)
    return ej.Measurement(stream.time[run], stream.value[run], label.astype(np.int32), mask)


@lru_cache
def program_of(estimator: ej.Estimator, steps: int) -> Any:
    """A function of (params, track, prior, key) that gives what `run` does, compiled at its first
    call, and the seconds that took; one for equal filters and tracks of as many rows."""
    made: list[Any] = []

    def program(*given):
        if not made:
            start = clock.perf_counter()
            compiled = jax.jit(partial(_moments, estimator)).lower(*given).compile()
            made.extend([compiled, clock.perf_counter() - start])
        return made

    return program


def _moments(estimator, params, track, prior, key):
    trace = ej.run(estimator, params, track, prior=prior, t0=0.0, key=key)
    return trace.mean, trace.cov


def _live_us(method: Ours, track: ej.Measurement, prior: ej.Gaussian) -> float:
    """Microseconds of `step`, the median over some arrivals after the first."""
    estimator, params = method.estimator, method.params
    state = estimator.init(params, prior, np.float64(0.0), jax.random.key(0))
    times = []
    for k, arrival in enumerate(ej.arrivals(track)):
        start = clock.perf_counter()
        state, _ = ej.step(estimator, params, state, arrival)
        jax.block_until_ready(state)
        times.append(clock.perf_counter() - start)
        if k > LIVE:
            break
    return 1e6 * float(np.median(times[3:]))
