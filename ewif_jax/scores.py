"""What one estimate is worth, arrival by arrival: the common ground of losses and metrics.

A score is a function (step, truth (k,), mask (m,)) -> () of one run after one arrival. NaN means
"cannot say" (nothing known yet, nothing measured) and is left out of averages; infinity is a score
like others. Where the filter's numbers are no estimates (a log likelihood that is -inf or NaN
beside something else that is not a number, or a covariance that is none) a score is infinite.
"""

import inspect
from collections.abc import Callable, Mapping
from functools import cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.scipy.special import gammainc

from ewif_jax import checks
from ewif_jax.analysis import consistency
from ewif_jax.batch import Observer, Step, run_batch
from ewif_jax.fast.compiling import array
from ewif_jax.kernels import gaussian
from ewif_jax.kernels.forecasts import gaussian_crps, gaussian_energy
from ewif_jax.recursions.contract import is_used
from ewif_jax.streams import checked_stream, float_dtype, present_values
from ewif_jax.types import Estimator, Measurement, Numbers, Params, Status

Score = Callable[[Step, Array, Array], Array]


def squared_error(step: Step, truth: Array, mask: Array) -> Array:
    """Squared distance of the first k components of the mean from the truth (k,)."""
    del mask
    error = step.mean[: truth.shape[0]] - truth
    is_finite = jnp.all(jnp.isfinite(error))
    square = jnp.sum(jnp.square(jnp.where(is_finite, error, 0)))
    # An estimate or truth that is NaN says nothing; one that has run away is as wrong as can be.
    rest = jnp.where(jnp.any(jnp.isnan(error)), _silent_or_broken(step), jnp.inf)
    return jnp.where(is_finite, square, jnp.where(jnp.any(jnp.isnan(truth)), jnp.nan, rest))


def normalised_error(step: Step, truth: Array, mask: Array) -> Array:
    """NEES divided by its expectation k: 1 on average if the covariance is honest."""
    del mask
    ratio = consistency.nees(step.mean, step.cov, truth) / truth.shape[0]
    absent = jnp.any(jnp.isnan(truth))
    return jnp.where(jnp.isnan(ratio) & ~absent, _silent_or_broken(step), ratio)


def normalised_innovation(step: Step, truth: Array, mask: Array) -> Array:
    """NIS per measured component: 1 on average if consistent; NaN if none was used."""
    del truth
    count = jnp.maximum(jnp.sum(mask).astype(step.mean.dtype), 1)
    return _where_used(step, consistency.nis(step.info) / count)


def negative_log_likelihood(step: Step, truth: Array, mask: Array) -> Array:
    """Minus the log likelihood of the measurement; NaN if it was not used."""
    del truth, mask
    return _where_used(step, -step.info.log_likelihood)


def squared_innovation(step: Step, truth: Array, mask: Array) -> Array:
    """Squared one-step prediction error; NaN if the measurement was not used."""
    del truth, mask
    return _where_used(step, _squared_length(step))


def robust_innovation(step: Step, truth: Array, mask: Array) -> Array:
    """Length of the one-step prediction error, which outliers pull less; NaN as above."""
    del truth, mask
    square = _squared_length(step)
    length = jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1)), square)
    return _where_used(step, length)


def crps(step: Step, truth: Array, mask: Array) -> Array:
    """The continuous ranked probability score of the predicted Gaussian, summed over components;
    NaN if the measurement was not used."""
    del truth
    spread = jnp.diagonal(step.info.innovation_cov)
    each = gaussian_crps(_defined_innovation(step), _safe_root(spread))
    return _where_used(step, jnp.sum(jnp.where(mask, each, 0)))


def energy(step: Step, truth: Array, mask: Array) -> Array:
    """The energy score of the predicted Gaussian; NaN if the measurement was not used."""
    del truth
    both = mask[:, None] & mask[None, :]
    cov = jnp.where(both, step.info.innovation_cov, 0)
    cov = jnp.where(jnp.all(jnp.isfinite(cov)), cov, 0)
    return _where_used(step, gaussian_energy(_defined_innovation(step), cov))


def surprise(step: Step, truth: Array, mask: Array) -> Array:
    """The probability that a chi-square number is smaller than the NIS: uniform if consistent; NaN
    if the measurement was not used."""
    del truth
    square = consistency.nis(step.info)
    is_defined = jnp.isfinite(square)
    # Near 0 the distribution of one component is infinitely steep.
    half = jnp.maximum(jnp.where(is_defined, square, 1) / 2, jnp.finfo(square.dtype).tiny)
    freedom = jnp.maximum(jnp.sum(mask).astype(square.dtype), 1) / 2
    return _where_used(step, jnp.where(is_defined, gammainc(freedom, half), jnp.nan))


def of_components(score: Score, of_values: bool) -> Score:
    """The score of those components only that count: its `mask`, of measured values (their joint
    density is the Gaussian of innovation and covariance) or else of the truth."""
    return _of_values(score) if of_values else _of_truth(score)


@cache
def _of_values(score: Score) -> Score:
    def of_some(step: Step, truth: Array, mask: Array) -> Array:
        info = step.info
        innovation = gaussian.innovate(
            _defined_innovation(step),
            jnp.zeros((mask.shape[0], 1), step.mean.dtype),
            info.innovation_cov,
            mask,
        )
        likelihood = jnp.where(
            jnp.isfinite(info.log_likelihood) & (info.log_likelihood != 0),
            gaussian.log_density(innovation, mask),
            info.log_likelihood,
        )
        # What is not a number stays so: it says why there is no score, and the charge takes its
        # place.
        shown = jnp.where(jnp.isfinite(info.innovation), innovation.value, info.innovation)
        some = info._replace(
            innovation=shown, innovation_cov=innovation.cov, log_likelihood=likelihood
        )
        found = score(step._replace(info=some), truth, mask)
        return jnp.where(jnp.any(mask), found, jnp.nan)

    return of_some


@cache
def _of_truth(score: Score) -> Score:
    def of_some(step: Step, truth: Array, counts: Array) -> Array:
        k = truth.shape[0]
        # What does not count is estimated exactly, with a variance that is known.
        shown = jnp.where(counts | jnp.isnan(truth), truth, step.mean[:k])
        found = score(step, shown, counts)
        return jnp.where(jnp.any(counts), found, jnp.nan)

    return of_some


def _defined_innovation(step: Step) -> Array:
    """The innovation; 0 where it is not a number."""
    innovation = step.info.innovation
    return jnp.where(jnp.isfinite(innovation), innovation, 0)


def _safe_root(x: Array) -> Array:
    is_positive = x > 0
    return jnp.where(is_positive, jnp.sqrt(jnp.where(is_positive, x, 1)), 0)


def scored(
    estimator: Estimator,
    params: Params,
    measurements: Measurement,
    truth: Numbers = None,
    *,
    scores: Mapping[str, Score],
    counted: Numbers = None,
    **setting: Any,
) -> dict[str, Array]:
    """Scores (R, T) of every run and arrival, in the fast layout of `run_batch`.

    Args:
        estimator, params: as in `run_batch`.
        measurements: a batch (R, T, ...); a single stream (T, ...) is a batch of one.
        truth: (T, k) or (R, T, k), NaN where there is none; None for scores that need none.
        scores: functions (step, truth, mask) -> () by name.
        counted: (1 or R, T, k) which components count, of the truth, or of the values if there is
            no truth: the scores' `mask`; default the measurements' mask.
        **setting: prior, t0, times, clock, key, params_per_run, devices, ... as in `run_batch`.

    Raises:
        ValueError: what `run_batch` refuses; a truth of another length, or infinite; something in
            `scores` that is no score.
    """
    for name, score in scores.items():
        checks.require(callable(score), f"metrics[{name!r}]", _SCORE, repr(score))
    measurements = as_batch(measurements)
    checked_stream(measurements, batched=True)
    runs, steps = np.shape(measurements.value)[:2]
    truth = array(np.zeros((steps, 0)) if truth is None else truth)
    lead = ("R", "T") if truth.ndim == 3 else ("T",)
    checks.shape("truth", truth, (*lead, "k"))
    same = truth.shape[-2] == steps and (truth.ndim == 2 or truth.shape[0] == runs)
    checks.require(same, "truth", f"{runs} runs and {steps} arrivals", f"shape {truth.shape}")
    mask = array(measurements.mask)
    if counted is not None:
        counted = array(counted)
        counted = counted[0] if counted.shape[0] == 1 else counted
        if truth.shape[-1]:
            mask = counted
        else:
            ranks = max(mask.ndim, counted.ndim)
            wide = [x[None] if x.ndim < ranks else x for x in (mask, counted)]
            mask = wide[0] & wide[1]
            mask = mask[0] if mask.shape[0] == 1 and mask.ndim == 3 and runs > 1 else mask
    return run_batch(
        estimator,
        params,
        measurements,
        **setting,
        observe=_all_of(tuple(scores.items())),
        context=(truth.astype(float_dtype(measurements.value)), mask),
        context_per_run=(truth.ndim == 3, mask.ndim == 3),
    )


def as_batch(measurements: Measurement) -> Measurement:
    """A single stream (T, ...) as a batch of one; a batch as it is."""
    ok = isinstance(measurements, Measurement)
    checks.require(ok, "measurements", "a Measurement", type(measurements).__name__)
    value = present_values(measurements.value, measurements.mask)
    if np.ndim(value) != 2:
        return measurements
    return measurements._replace(value=array(value)[None])


@partial(jax.jit, static_argnames="axis", inline=True)
def average(values: Array, axis: int | None = None) -> Array:
    """Mean over `axis` of the values that are not NaN; NaN if there are none."""
    is_score = ~jnp.isnan(values)
    count = jnp.sum(is_score, axis)
    total = jnp.sum(jnp.where(is_score, values, 0), axis)
    return jnp.where(count > 0, total / jnp.maximum(count, 1), jnp.nan)


_SCORE = "a score: a function (step, truth (k,), mask (m,)) -> () of one run after one arrival"


@cache
def _all_of(scores: tuple[tuple[str, Score], ...]) -> Observer:
    """The observer of several scores by name; one object for equal scores, so that nothing is
    compiled again."""

    def observe(step: Step, seen: tuple[Array, Array]) -> dict[str, Array]:
        return {name: score_of(name, score, step, *seen) for name, score in scores}

    return observe


def score_of(name: str, score: Score, step: Step, truth: Array, mask: Array) -> Array:
    """The score, or an error that says what a score is: functions of arrays look like scores."""
    try:
        inspect.signature(score).bind(step, truth, mask)
        found = score(step, truth, mask)
        shape = jnp.shape(found)
    except (TypeError, AttributeError) as error:
        got = f"{getattr(score, '__name__', score)}, which fails with: {error}"
        raise ValueError(f"metrics[{name!r}]: expected {_SCORE}, got {got}") from error
    checks.require(shape == (), f"metrics[{name!r}]", _SCORE, f"shape {shape}")
    return jnp.asarray(found)


def _where_used(step: Step, score: Array) -> Array:
    """`score` of a measurement that was used and predicted, otherwise NaN; infinite where
    variances or densities are none."""
    log_likelihood = step.info.log_likelihood
    said = jnp.all(jnp.isfinite(step.info.innovation)) & ~jnp.isnan(log_likelihood)
    kept = jnp.where(jnp.isnan(score), jnp.inf, score)
    # What is not predicted has log likelihood 0 if nothing is known; else it is -inf or NaN.
    silent = jnp.where(jnp.isfinite(log_likelihood), _silent_or_broken(step), jnp.inf)
    return jnp.where(is_used(step.info), jnp.where(said, kept, silent), _silent_or_broken(step))


def _silent_or_broken(step: Step) -> Array:
    """Where there is no number: infinity if what came is outside of its domain (a covariance of the
    innovation that is NaN is refused), else NaN.

    The likelihood would say so too, but every run would have to compute it for an RMSE; this
    covariance all runs share.
    """
    is_broken = jnp.any(jnp.isnan(step.info.innovation_cov))
    is_broken &= step.info.status == Status.REJECTED
    return jnp.where(is_broken, jnp.inf, jnp.nan)


def _squared_length(step: Step) -> Array:
    """The squared length of the innovation; 0 where it is not a number."""
    innovation = step.info.innovation
    is_defined = is_used(step.info) & jnp.all(jnp.isfinite(innovation))
    return jnp.sum(jnp.square(jnp.where(is_defined, innovation, 0)))
