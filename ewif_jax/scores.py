"""What one estimate is worth, arrival by arrival: the common ground of losses and metrics.

A score is a function (step, truth (k,), mask (m,)) -> () of one run after one arrival; NaN means
"cannot say" (nothing known yet, nothing measured) and is left out of averages.
"""

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from ewif_jax import checks
from ewif_jax.analysis.consistency import nees, nis
from ewif_jax.batch import Step, check_runs, flagged, scan_batch
from ewif_jax.estimator import Clock, cast, float_dtype
from ewif_jax.layout import Frozen, device_count, over_devices, runs_last
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
    value = jnp.asarray(measurements.value)
    if value.ndim == 2:
        measurements = measurements._replace(value=value[None])
    checks.stream(measurements, batched=True)
    runs, steps = jnp.shape(measurements.value)[:2]
    truth = jnp.zeros((steps, 0)) if truth is None else jnp.asarray(truth)
    lead = ("R", "T") if truth.ndim == 3 else ("T",)
    checks.shape("truth", truth, (*lead, "k"))
    same = truth.shape[-2] == steps and (truth.ndim == 2 or truth.shape[0] == runs)
    checks.require(same, "truth", f"{runs} runs and {steps} arrivals", f"shape {truth.shape}")
    inputs, flags = flagged(params, params_per_run, measurements, prior, times)
    check_runs(estimator, inputs, flags, t0, clock, key)
    keys = None if key is None else key if jnp.ndim(key) == 1 else jax.random.split(key, runs)
    return _scored(
        estimator,
        inputs,
        truth,
        t0,
        keys,
        Frozen((flags, truth.ndim == 3)),
        clock,
        tuple(scores.items()),
        device_count(runs, devices),
    )


def average(values: Array, axis: int | None = None) -> Array:
    """Mean over `axis` of the values that are not NaN; NaN if there are none."""
    known = jnp.isfinite(values)
    count = jnp.sum(known, axis)
    total = jnp.sum(jnp.where(known, values, 0), axis)
    return jnp.where(count > 0, total / jnp.maximum(count, 1), jnp.nan)


@partial(jax.jit, static_argnames=("estimator", "flags", "clock", "scores", "devices"))
def _scored(
    estimator: Estimator,
    inputs: Any,
    truth: Array,
    t0: Any,
    keys: Any,
    flags: Frozen,
    clock: Clock,
    scores: tuple[tuple[str, Score], ...],
    devices: int,
) -> dict[str, Array]:
    input_f, truth_f = flags.tree
    params, measurements, prior, times = inputs
    dtype = float_dtype(measurements.value)
    mask = jnp.asarray(measurements.mask, bool)
    wide = measurements._replace(mask=mask if input_f[1].mask else mask[None])
    measurements = cast(wide, dtype)._replace(mask=mask)
    inputs = (params, measurements, prior, None if times is None else jnp.asarray(times, dtype))
    inputs = runs_last(inputs, input_f)
    truth = runs_last(jnp.asarray(truth, dtype), truth_f)

    def observe(step: Step, seen: tuple[Array, Array]) -> dict[str, Array]:
        return {name: score(step, *seen) for name, score in scores}

    def filtered(inputs: Any, keys: Any, truth: Array) -> dict[str, Array]:
        context, context_f = (truth, inputs[1].mask), (truth_f, input_f[1].mask)
        (seen, seen_f), _ = scan_batch(
            estimator, inputs, input_f, t0, keys, clock, observe, context, context_f
        )
        count = inputs[1].value.shape[-1]
        return jax.tree.map(
            lambda x, f: x if f else jnp.broadcast_to(x[:, None], (x.shape[0], count)),
            seen,
            seen_f,
        )

    in_f = (input_f, None if keys is None else True, truth_f)
    out_f = {name: True for name, _ in scores}
    out = over_devices(filtered, in_f, out_f, devices)(inputs, keys, truth)
    return jax.tree.map(lambda x: x.T, out)


def _used(step: Step) -> Array:
    used = (step.info.status == Status.USED) | (step.info.status == Status.LATE_USED)
    return used & jnp.all(jnp.isfinite(step.info.innovation))


def _of_innovation(step: Step, measure: Callable[[Array], Array]) -> Array:
    used = _used(step)
    square = jnp.sum(jnp.square(jnp.where(used, step.info.innovation, 0)))
    return jnp.where(used, measure(square), jnp.nan)
