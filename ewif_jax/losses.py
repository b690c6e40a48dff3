"""Losses of an estimator's parameters: functions params -> () for `tune`, `jax.grad` and plots."""

from collections.abc import Callable, Mapping
from typing import Any

import jax.numpy as jnp
from jax import Array

from ewif_jax import scores
from ewif_jax.scores import Score, average, scored
from ewif_jax.types import Estimator, Measurement

Loss = Callable[..., Array]


def rmse_loss(estimator: Estimator, measurements: Measurement, truth: Any, **setting: Any) -> Loss:
    """params -> RMSE of the first k state components over all runs and arrivals.

    `measurements` is a stream (T, ...) or a batch (R, T, ...), `truth` (T, k) or (R, T, k);
    `setting` (prior, t0, times, clock, key, devices) as in `run_batch`.
    """
    return _loss(estimator, measurements, truth, scores.squared_error, jnp.sqrt, setting)


def likelihood_loss(estimator: Estimator, measurements: Measurement, **setting: Any) -> Loss:
    """params -> mean negative log likelihood of a measurement given the earlier ones."""
    score = scores.negative_log_likelihood
    return _loss(estimator, measurements, None, score, lambda x: x, setting)


def prediction_loss(
    estimator: Estimator, measurements: Measurement, *, robust: bool = False, **setting: Any
) -> Loss:
    """params -> root mean square of the one-step prediction errors, or their mean length
    (`robust`, which outliers pull less). Needs no truth."""
    if robust:
        score = scores.robust_innovation
        return _loss(estimator, measurements, None, score, lambda x: x, setting)
    return _loss(estimator, measurements, None, scores.squared_innovation, jnp.sqrt, setting)


def nees_loss(estimator: Estimator, measurements: Measurement, truth: Any, **setting: Any) -> Loss:
    """params -> squared log of the average NEES over its expectation: 0 if consistent."""
    score = scores.normalised_error
    return _loss(estimator, measurements, truth, score, _squared_log, setting)


def nis_loss(estimator: Estimator, measurements: Measurement, **setting: Any) -> Loss:
    """params -> squared log of the average NIS over its expectation: 0 if consistent."""
    score = scores.normalised_innovation
    return _loss(estimator, measurements, None, score, _squared_log, setting)


def _loss(
    estimator: Estimator,
    measurements: Measurement,
    truth: Any,
    score: Score,
    finish: Callable[[Array], Array],
    setting: Mapping[str, Any],
) -> Loss:
    def loss(params: Any) -> Array:
        values = scored(estimator, params, measurements, truth, scores={"score": score}, **setting)
        return finish(average(values["score"]))

    return loss


def _squared_log(ratio: Array) -> Array:
    return jnp.square(jnp.log(ratio))
