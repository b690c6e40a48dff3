"""Losses of an estimator's parameters: functions params -> () for `tune`, `jax.grad` and plots.

**Which rows count** is fixed by the data, never by the parameters. A row that is present in the
data and that the filter does not use or cannot predict (`TOO_LATE`, `REJECTED`, its information
gone) costs what it costs a predictor that knows only the mean and the spread of that sensor's
values over all runs: its squared error about the mean (its root for lengths), its density under a
Gaussian ten times as wide as they spread. With `prior=None`, rows before n components have been
measured (n states) do not count, nor do rows of which nothing is present. So moving a latency, a
cut-off, a gate or tau until rows go unused does not lower the loss of a stream that was predicted
well. ``unused="leave out"`` leaves such rows out instead, as they come.

**Which rows you count** say two arguments of every loss: ``where=``, booleans (T,) or (R, T) for
rows, or with a last axis for components (of the measurements; of the truth in `rmse_loss`), and
``warm_up=``, how many measured rows at the start of each run do not count. The filter still uses
all rows; those left out cost nothing and divide nothing. Masked and missing rows never count where
measurements are predicted; an RMSE counts the estimate there too, so that a long gap can dominate
it (``where=`` of the measured rows leaves it out).

``ahead=k`` of the losses of predictions: each measurement is predicted from those that arrived k or
more before it; a sequence of horizons means the mean of their losses.

An infinite score makes a loss infinite. Values out of their domain (a negative variance) make it
infinite too. With no row to score at all it is 0.
"""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array

from ewif_jax import checks, scores
from ewif_jax.averages import averaged, consistency_of, itself, of_predictions, or_infinite, root_of
from ewif_jax.charges import density_cost, length_cost, squared_cost
from ewif_jax.charging import Charging, Rows, Unused, truth_charging, value_charging
from ewif_jax.forecast_losses import crps_loss, energy_loss, nis_shape_loss
from ewif_jax.types import Estimator, Measurement, Numbers, Params

Loss = Callable[..., Array]
__all__ = [
    "Loss",
    "crps_loss",
    "energy_loss",
    "likelihood_loss",
    "log_likelihood",
    "nees_loss",
    "nis_loss",
    "nis_shape_loss",
    "prediction_loss",
    "rmse_loss",
]


def rmse_loss(
    estimator: Estimator,
    measurements: Measurement,
    truth: Numbers,
    *,
    unused: Unused = "charge",
    where: Numbers = None,
    warm_up: int = 0,
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
        where: which rows, or which components (..., k) of the truth, count.
        warm_up: how many measured rows at the start of each run do not count.
        **setting: prior, t0, times, clock, key, devices, ... as in `run_batch`.

    Returns:
        A function of `params`, differentiable in forward and reverse mode.

    Raises:
        ValueError: (when called) what `run_batch` refuses; a truth of the wrong shape; an unknown
            `unused`.
    """
    rows = Rows(where, warm_up)
    charging = truth_charging(estimator, measurements, truth, unused, setting, rows)
    return averaged(charging, truth, scores.squared_error, root_of)


def likelihood_loss(
    estimator: Estimator,
    measurements: Measurement,
    *,
    unused: Unused = "charge",
    where: Numbers = None,
    warm_up: int = 0,
    ahead: Numbers = 1,
    **setting: Any,
) -> Loss:
    r"""params -> mean negative log likelihood of a measurement given the earlier ones.

    .. math::
        -\tfrac1N \sum_j \log p(z_j \mid z_1 \dots z_{j-1})

    Args:
        estimator, measurements, setting: as in `rmse_loss`.
        unused, where, warm_up, ahead: see the top of `ewif_jax.losses`. Of some components only,
            the density is that of the Gaussian of innovation and covariance.

    Returns:
        A function of `params`, differentiable in forward and reverse mode.
    """

    def average_score(charging: Charging) -> Loss:
        return averaged(charging, None, scores.negative_log_likelihood, itself)

    rows = Rows(where, warm_up)
    return of_predictions(
        estimator, measurements, setting, unused, rows, ahead, density_cost, average_score
    )


def log_likelihood(
    estimator: Estimator,
    params: Params,
    measurements: Measurement,
    *,
    unused: Unused = "charge",
    where: Numbers = None,
    warm_up: int = 0,
    **setting: Any,
) -> Array:
    r"""The log likelihood () of all measurements together, :math:`\log p(z_1 \dots z_T)`.

    The sum over the rows that `likelihood_loss` averages: what is present and not used is charged.

    Args:
        estimator: any `Estimator`.
        params: its parameters.
        measurements: a stream (T, ...) or a batch (R, T, ...), over which it is summed.
        unused: "charge" or "leave out" rows that are not used.
        where, warm_up: which rows count; see the top of `ewif_jax.losses`.
        **setting: prior, t0, times, clock, key, devices, ... as in `run_batch`.

    Returns:
        (); -inf where a value is out of its domain.
    """
    rows = Rows(where, warm_up)
    charging = value_charging(estimator, measurements, density_cost, unused, setting, rows)
    values = charging.scored(params, None, scores.negative_log_likelihood)
    total = jnp.sum(jnp.where(jnp.isnan(values), 0, values))
    return -or_infinite(total)


def prediction_loss(
    estimator: Estimator,
    measurements: Measurement,
    *,
    robust: bool = False,
    unused: Unused = "charge",
    where: Numbers = None,
    warm_up: int = 0,
    ahead: Numbers = 1,
    **setting: Any,
) -> Loss:
    r"""params -> root mean square of the one-step prediction errors; needs no truth.

    .. math::
        \sqrt{\tfrac1N \sum_j \| z_j - \hat z_{j|j-1} \|^2}

    Args:
        estimator, measurements, setting: as in `rmse_loss`.
        robust: the mean length of the errors instead, which outliers pull less.
        unused, where, warm_up, ahead: see the top of `ewif_jax.losses`.

    Returns:
        A function of `params`, differentiable in forward and reverse mode.
    """
    score, finish, cost = (
        (scores.robust_innovation, itself, length_cost)
        if robust
        else (scores.squared_innovation, root_of, squared_cost)
    )

    def average_score(charging: Charging) -> Loss:
        return averaged(charging, None, score, finish)

    rows = Rows(where, warm_up)
    return of_predictions(
        estimator, measurements, setting, unused, rows, ahead, cost, average_score
    )


def nees_loss(
    estimator: Estimator,
    measurements: Measurement,
    truth: Numbers,
    *,
    unused: Unused = "charge",
    where: Numbers = None,
    warm_up: int = 0,
    **setting: Any,
) -> Loss:
    """params -> squared log of the average NEES over its expectation: 0 if consistent.

    A row without an estimate costs log(100)^2, what the loss is where the covariance is a hundred
    times too wide; the loss is the average of that and of the loss over the other rows, weighted
    by how many they are. An average of exactly 0 counts as the smallest positive number.

    Args:
        estimator, measurements, truth, unused, warm_up, setting: as in `rmse_loss`.
        where: which rows count.

    Returns:
        A function of `params`, differentiable in forward and reverse mode.
    """
    if where is not None:
        whole = np.ndim(where) < np.ndim(measurements.value)
        checks.require(whole, "where", "rows, not components", f"shape {np.shape(where)}")
    rows = Rows(where, warm_up)
    charging = truth_charging(estimator, measurements, truth, unused, setting, rows)
    return consistency_of(charging, truth, scores.normalised_error)


def nis_loss(
    estimator: Estimator,
    measurements: Measurement,
    *,
    unused: Unused = "charge",
    where: Numbers = None,
    warm_up: int = 0,
    ahead: Numbers = 1,
    **setting: Any,
) -> Loss:
    """params -> squared log of the average NIS over its expectation: 0 if consistent.

    A row that is not used or predicted costs log(100)^2, as in `nees_loss`.

    Args:
        estimator, measurements, setting: as in `rmse_loss`.
        unused, where, warm_up, ahead: see the top of `ewif_jax.losses`.

    Returns:
        A function of `params`, differentiable in forward and reverse mode.
    """

    def average_score(charging: Charging) -> Loss:
        return consistency_of(charging, None, scores.normalised_innovation)

    rows = Rows(where, warm_up)
    return of_predictions(
        estimator, measurements, setting, unused, rows, ahead, squared_cost, average_score
    )
