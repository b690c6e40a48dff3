"""Losses of an estimator's parameters: functions params -> () for `tune`, `jax.grad` and plots.

**Which rows count** is fixed by the data, never by the parameters. A row that is present in the
data and that the filter does not use or cannot predict (`TOO_LATE`, `REJECTED`, its information
gone) costs what it costs a predictor that knows only the mean and the spread of that sensor's
values over all runs: its squared error about the mean (its root for lengths), its density under a
Gaussian ten times as wide as they spread. With `prior=None`, rows before n components have been
measured (n states) do not count, nor do rows of which nothing is present. So moving a latency, a
cut-off, a gate or tau until rows go unused does not lower the loss of a stream that was predicted
well. ``unused="leave out"`` leaves such rows out instead, as they come.

An infinite score makes a loss infinite. Values out of their domain (a negative variance) make it
infinite too. With no row to score at all it is 0.
"""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array

from ewif_jax import scores
from ewif_jax.charges import (
    WIDTH,
    density_cost,
    length_cost,
    squared_cost,
    truth_charges,
)
from ewif_jax.charging import Charging, Unused, charging_of, value_charging
from ewif_jax.scores import Score, average
from ewif_jax.types import Estimator, Measurement, Numbers, Params

Loss = Callable[..., Array]


def rmse_loss(
    estimator: Estimator,
    measurements: Measurement,
    truth: Numbers,
    *,
    unused: Unused = "charge",
    **setting: Any,
) -> Loss:
    r"""params -> RMSE of the first k state components over all runs and arrivals.

    .. math::
        \sqrt{\tfrac1N \sum_{r,j} \| \hat x_{r,j} - x_{r,j} \|^2}

    The estimate reported after every arrival counts, also after one that was missing, late or not
    used: there the filter predicts. A gap in the data costs what the filter's motion model makes
    of it. A row without an estimate (its information gone) costs the squared distance of its truth
    from the mean of the truth over all runs and rows. Rows whose truth is NaN do not count, nor,
    with `prior=None`, rows before n components have been measured.

    Args:
        estimator: any `Estimator`.
        measurements: a stream (T, ...) or a batch (R, T, ...).
        truth: (T, k) or (R, T, k), NaN where there is none.
        unused: "charge", or "leave out" rows without an estimate.
        **setting: prior, t0, times, clock, key, devices, ... as in `run_batch`.

    Returns:
        A function of `params`, differentiable in forward and reverse mode.

    Raises:
        ValueError: (when called) what `run_batch` refuses; a truth of the wrong shape; an unknown
            `unused`.
    """

    def charges(batch: Measurement, unknowns: int) -> Any:
        return truth_charges(truth, batch, unknowns)

    charging = charging_of(estimator, measurements, charges, unused, setting)
    return _averaged(charging, truth, scores.squared_error, _root)


def likelihood_loss(
    estimator: Estimator, measurements: Measurement, *, unused: Unused = "charge", **setting: Any
) -> Loss:
    r"""params -> mean negative log likelihood of a measurement given the earlier ones.

    .. math::
        -\tfrac1N \sum_j \log p(z_j \mid z_1 \dots z_{j-1})

    Args:
        estimator, measurements, setting: as in `rmse_loss`.
        unused: "charge" (see the top of `ewif_jax.losses`) or "leave out".

    Returns:
        A function of `params`, differentiable in forward and reverse mode.
    """
    charging = value_charging(estimator, measurements, density_cost, unused, setting)
    return _averaged(charging, None, scores.negative_log_likelihood, _itself)


def log_likelihood(
    estimator: Estimator,
    params: Params,
    measurements: Measurement,
    *,
    unused: Unused = "charge",
    **setting: Any,
) -> Array:
    r"""The log likelihood () of all measurements together, :math:`\log p(z_1 \dots z_T)`.

    The sum over the rows that `likelihood_loss` averages: what is present and not used is charged.

    Args:
        estimator: any `Estimator`.
        params: its parameters.
        measurements: a stream (T, ...) or a batch (R, T, ...), over which it is summed.
        unused: "charge" or "leave out" rows that are not used.
        **setting: prior, t0, times, clock, key, devices, ... as in `run_batch`.

    Returns:
        (); -inf where a value is out of its domain.
    """
    charging = value_charging(estimator, measurements, density_cost, unused, setting)
    values = charging.scored(params, None, scores.negative_log_likelihood)
    total = jnp.sum(jnp.where(jnp.isnan(values), 0, values))
    return -_or_infinite(total)


def prediction_loss(
    estimator: Estimator,
    measurements: Measurement,
    *,
    robust: bool = False,
    unused: Unused = "charge",
    **setting: Any,
) -> Loss:
    r"""params -> root mean square of the one-step prediction errors; needs no truth.

    .. math::
        \sqrt{\tfrac1N \sum_j \| z_j - \hat z_{j|j-1} \|^2}

    Args:
        estimator, measurements, setting: as in `rmse_loss`.
        robust: the mean length of the errors instead, which outliers pull less.
        unused: "charge" (see the top of `ewif_jax.losses`) or "leave out".

    Returns:
        A function of `params`, differentiable in forward and reverse mode.
    """
    cost = length_cost if robust else squared_cost
    charging = value_charging(estimator, measurements, cost, unused, setting)
    if robust:
        return _averaged(charging, None, scores.robust_innovation, _itself)
    return _averaged(charging, None, scores.squared_innovation, _root)


def nees_loss(
    estimator: Estimator,
    measurements: Measurement,
    truth: Numbers,
    *,
    unused: Unused = "charge",
    **setting: Any,
) -> Loss:
    """params -> squared log of the average NEES over its expectation: 0 if consistent.

    A row without an estimate costs log(100)^2, what the loss is where the covariance is a hundred
    times too wide; the loss is the average of that and of the loss over the other rows, weighted
    by how many they are. An average of exactly 0 counts as the smallest positive number.

    Args:
        estimator, measurements, truth, unused, setting: as in `rmse_loss`.

    Returns:
        A function of `params`, differentiable in forward and reverse mode.
    """

    def charges(batch: Measurement, unknowns: int) -> Any:
        return truth_charges(truth, batch, unknowns)

    charging = charging_of(estimator, measurements, charges, unused, setting)
    return _consistency(charging, truth, scores.normalised_error)


def nis_loss(
    estimator: Estimator, measurements: Measurement, *, unused: Unused = "charge", **setting: Any
) -> Loss:
    """params -> squared log of the average NIS over its expectation: 0 if consistent.

    A row that is not used or predicted costs log(100)^2, as in `nees_loss`.

    Args:
        estimator, measurements, unused, setting: as in `rmse_loss`.

    Returns:
        A function of `params`, differentiable in forward and reverse mode.
    """
    charging = value_charging(estimator, measurements, squared_cost, unused, setting)
    return _consistency(charging, None, scores.normalised_innovation)


def _averaged(
    charging: Charging, truth: Numbers, score: Score, finish: Callable[[Array], Array]
) -> Loss:
    def loss(params: Params) -> Array:
        return _or_infinite(finish(_mean(charging.scored(params, truth, score))))

    return loss


def _consistency(charging: Charging, truth: Numbers, score: Score) -> Loss:
    def loss(params: Params) -> Array:
        values = charging.raw(params, truth, score)
        if charging.unused == "leave out":
            return _or_infinite(_squared_log(average(values)))
        charge = jnp.broadcast_to(jnp.asarray(charging.charge(params)), values.shape)
        counted = ~jnp.isnan(charge)
        values = jnp.where(counted, values, jnp.nan)
        rows, answered = jnp.sum(counted), jnp.sum(~jnp.isnan(values))
        share, silent = (
            x.astype(values.dtype) / jnp.maximum(rows, 1).astype(values.dtype)
            for x in (answered, rows - answered)
        )
        seen = _squared_log(jnp.where(answered > 0, _mean(values), 1))
        return _or_infinite(share * seen + silent * _WIDE)

    return loss


_WIDE = float(np.log(WIDTH**2) ** 2)


def _mean(values: Array) -> Array:
    """The mean of what is not NaN; 0 of nothing."""
    is_score = ~jnp.isnan(values)
    count = jnp.maximum(jnp.sum(is_score), 1).astype(values.dtype)
    return jnp.sum(jnp.where(is_score, values, 0)) / count


def _itself(x: Array) -> Array:
    return x


def _root(x: Array) -> Array:
    """The root, with derivative 0 at 0: where no error is left there is nothing to tune."""
    return jnp.where(x > 0, jnp.sqrt(jnp.where(x > 0, x, 1)), x)


def _squared_log(ratio: Array) -> Array:
    tiny = jnp.finfo(ratio.dtype).tiny
    return jnp.square(jnp.log(jnp.where(ratio < tiny, tiny, ratio)))


def _or_infinite(loss: Array) -> Array:
    return jnp.where(jnp.isnan(loss), jnp.inf, loss)
