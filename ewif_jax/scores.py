"""What one estimate is worth, arrival by arrival: the common ground of losses and metrics.

A score is a function (step, truth (k,), mask (m,)) -> () of one run after one arrival; NaN means
"cannot say" (nothing known yet, nothing measured) and is left out of averages.
"""

from collections.abc import Callable, Mapping
from functools import cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ewif_jax import checks
from ewif_jax.analysis.consistency import nees, nis
from ewif_jax.batch import Observer, Step, run_batch
from ewif_jax.estimator import Clock
from ewif_jax.fast.compiling import array
from ewif_jax.streams import checked_stream, float_dtype
from ewif_jax.types import Estimator, Gaussian, Measurement, Status

Score = Callable[[Step, Array, Array], Array]


def squared_error(step: Step, truth: Array, mask: Array) -> Array:
    """Squared distance of the first k components of the mean from the truth (k,)."""
    del mask
    error = step.mean[: truth.shape[0]] - truth
    known = jnp.all(jnp.isfinite(error))
    return jnp.where(known, jnp.sum(jnp.square(jnp.where(known, error, 0))), jnp.nan)


def normalised_error(step: Step, truth: Array, mask: Array) -> Array:
    """NEES divided by its expectation k: 1 on average if the covariance is honest."""
    del mask
    return nees(step.mean, step.cov, truth) / truth.shape[0]


def normalised_innovation(step: Step, truth: Array, mask: Array) -> Array:
    """NIS per measured component: 1 on average if consistent; NaN if none was used."""
    del truth
    count = jnp.maximum(jnp.sum(mask).astype(step.mean.dtype), 1)
    return jnp.where(_used(step), nis(step.info) / count, jnp.nan)


def negative_log_likelihood(step: Step, truth: Array, mask: Array) -> Array:
    """Minus the log likelihood of the measurement; NaN if it was not used."""
    del truth, mask
    return jnp.where(_used(step), -step.info.log_likelihood, jnp.nan)


def squared_innovation(step: Step, truth: Array, mask: Array) -> Array:
    """Squared one-step prediction error; NaN if the measurement was not used."""
    del truth, mask
    return _of_innovation(step, lambda square: square)


def robust_innovation(step: Step, truth: Array, mask: Array) -> Array:
    """Length of the one-step prediction error, which outliers pull less; NaN as above."""
    del truth, mask

    def length(square: Array) -> Array:
        safe = jnp.where(square > 0, square, 1)
        return jnp.where(square > 0, jnp.sqrt(safe), 0)

    return _of_innovation(step, length)


def scored(
    estimator: Estimator,
    params: Any,
    measurements: Measurement,
    truth: Any = None,
    *,
    scores: Mapping[str, Score],
    prior: Gaussian | None,
    t0: Any,
    times: Any = None,
    clock: Clock = "validity",
    key: Any = None,
    params_per_run: Any = False,
    devices: int | None = None,
) -> dict[str, Array]:
    """Scores (R, T) of every run and arrival, in the fast layout of `run_batch`.

    Arguments as in `run_batch`; a single stream is a batch of one. `truth` is (T, k) or
    (R, T, k), or None for scores that need none; `key` may be one typed key for each run.
    """
    if np.ndim(measurements.value) == 2:
        measurements = measurements._replace(value=array(measurements.value)[None])
    checked_stream(measurements, batched=True)
    runs, steps = np.shape(measurements.value)[:2]
    truth = array(np.zeros((steps, 0)) if truth is None else truth)
    lead = ("R", "T") if truth.ndim == 3 else ("T",)
    checks.shape("truth", truth, (*lead, "k"))
    same = truth.shape[-2] == steps and (truth.ndim == 2 or truth.shape[0] == runs)
    checks.require(same, "truth", f"{runs} runs and {steps} arrivals", f"shape {truth.shape}")
    mask = array(measurements.mask)
    return run_batch(
        estimator,
        params,
        measurements,
        prior=prior,
        t0=t0,
        times=times,
        clock=clock,
        key=key,
        params_per_run=params_per_run,
        observe=_all_of(tuple(scores.items())),
        context=(truth.astype(float_dtype(measurements.value)), mask),
        context_per_run=(truth.ndim == 3, mask.ndim == 3),
        devices=devices,
    )


@partial(jax.jit, static_argnames="axis", inline=True)
def average(values: Array, axis: int | None = None) -> Array:
    """Mean over `axis` of the values that are not NaN; NaN if there are none."""
    known = jnp.isfinite(values)
    count = jnp.sum(known, axis)
    total = jnp.sum(jnp.where(known, values, 0), axis)
    return jnp.where(count > 0, total / jnp.maximum(count, 1), jnp.nan)


@cache
def _all_of(scores: tuple[tuple[str, Score], ...]) -> Observer:
    """The observer of several scores by name; one object for equal scores, so that nothing is
    compiled again."""

    def observe(step: Step, seen: tuple[Array, Array]) -> dict[str, Array]:
        return {name: score(step, *seen) for name, score in scores}

    return observe


def _used(step: Step) -> Array:
    used = (step.info.status == Status.USED) | (step.info.status == Status.LATE_USED)
    return used & jnp.all(jnp.isfinite(step.info.innovation))


def _of_innovation(step: Step, measure: Callable[[Array], Array]) -> Array:
    used = _used(step)
    square = jnp.sum(jnp.square(jnp.where(used, step.info.innovation, 0)))
    return jnp.where(used, measure(square), jnp.nan)
