"""Losses of forecasts as distributions, for data without truth. Which rows count, and what those
cost that are not predicted, is said at the top of `ewif_jax.losses`."""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
from jax import Array

from ewif_jax import scores
from ewif_jax.averages import averaged, itself, of_predictions, or_infinite
from ewif_jax.charges import crps_cost, energy_cost, squared_cost
from ewif_jax.charging import Charging, Rows, Unused
from ewif_jax.scores import Score
from ewif_jax.types import Estimator, Measurement, Numbers, Params

Loss = Callable[..., Array]


def crps_loss(
    estimator: Estimator,
    measurements: Measurement,
    *,
    unused: Unused = "charge",
    where: Numbers = None,
    warm_up: int = 0,
    ahead: Numbers = 1,
    **setting: Any,
) -> Loss:
    r"""params -> mean continuous ranked probability score of the predicted measurements.

    .. math::
        \int \left( F(x) - [x \ge z] \right)^2 dx
            = \sigma \left( u (2 \Phi(u) - 1) + 2 \varphi(u) - 1 / \sqrt\pi \right), \quad
            u = \nu / \sigma

    Summed over the components of a row; in the units of the measurements, as a mean absolute error,
    which it is for forecasts without spread. It is least for the right distribution, and outliers
    pull it less than the likelihood.

    Args:
        estimator, measurements, setting: as in `rmse_loss`.
        unused, where, warm_up, ahead: see the top of `ewif_jax.losses`. A row that is not predicted
            costs what the Gaussian does that is ten times as wide as the values spread.

    Returns:
        A function of `params`, differentiable in forward and reverse mode.
    """

    def average_score(charging: Charging) -> Loss:
        return averaged(charging, None, scores.crps, itself)

    rows = Rows(where, warm_up)
    return of_predictions(
        estimator, measurements, setting, unused, rows, ahead, crps_cost, average_score
    )


def energy_loss(
    estimator: Estimator,
    measurements: Measurement,
    *,
    unused: Unused = "charge",
    where: Numbers = None,
    warm_up: int = 0,
    ahead: Numbers = 1,
    **setting: Any,
) -> Loss:
    r"""params -> mean energy score of the predicted measurements: the CRPS of vectors.

    .. math::
        E \| Z - z \| - \tfrac12 E \| Z - Z' \|, \quad Z, Z' \sim N(\hat z, S)

    It also sees correlations between components, whose scale should be alike. The expectations are
    integrals in one dimension (`kernels.forecasts`), no samples.

    Args:
        estimator, measurements, unused, where, warm_up, ahead, setting: as in `crps_loss`.

    Returns:
        A function of `params`, differentiable in forward and reverse mode.

    Reduces to: `crps_loss` for one component.
    """

    def average_score(charging: Charging) -> Loss:
        return averaged(charging, None, scores.energy, itself)

    rows = Rows(where, warm_up)
    return of_predictions(
        estimator, measurements, setting, unused, rows, ahead, energy_cost, average_score
    )


def nis_shape_loss(
    estimator: Estimator,
    measurements: Measurement,
    *,
    unused: Unused = "charge",
    where: Numbers = None,
    warm_up: int = 0,
    ahead: Numbers = 1,
    **setting: Any,
) -> Loss:
    r"""params -> how far the NIS are from being chi-square numbers, not only in their mean.

    .. math::
        \frac{1}{12 N^2} + \frac1N \sum_{i=1}^N \left( u_{(i)} - \frac{2 i - 1}{2 N} \right)^2,
            \quad u = F_{\chi^2_m}(\nu' S^{-1} \nu)

    The Cramer-von Mises distance of their probabilities u, in increasing order, from uniform ones;
    about 1 / (6 N) if the filter is consistent, 1/3 if all are far too small or too large.

    Args:
        estimator, measurements, where, warm_up, ahead, setting: as in `crps_loss`.
        unused: "charge": a row that is not predicted counts as u = 1; or "leave out".

    Returns:
        A function of `params`, differentiable in forward and reverse mode almost everywhere.
    """

    def average_score(charging: Charging) -> Loss:
        return _shape_loss(charging, scores.surprise)

    rows = Rows(where, warm_up)
    return of_predictions(
        estimator, measurements, setting, unused, rows, ahead, squared_cost, average_score
    )


def _shape_loss(charging: Charging, score: Score) -> Loss:
    def loss(params: Params) -> Array:
        values = charging.raw(params, None, score)
        if charging.unused == "charge":
            charge = jnp.broadcast_to(jnp.asarray(charging.charge(params)), values.shape)
            answered = jnp.where(jnp.isnan(values) | jnp.isinf(values), 1, values)
            values = jnp.where(jnp.isnan(charge), jnp.nan, answered)
        # What does not count sorts behind all probabilities.
        counts = jnp.ravel(~jnp.isnan(values))
        ordered = jnp.sort(jnp.where(counts, jnp.ravel(values), 2))
        count = jnp.maximum(jnp.sum(counts), 1).astype(values.dtype)
        ranks = jnp.arange(1, ordered.size + 1, dtype=values.dtype)
        apart = jnp.where(ranks <= jnp.sum(counts), ordered - (2 * ranks - 1) / (2 * count), 0)
        distance = 1 / (12 * jnp.square(count)) + jnp.sum(jnp.square(apart)) / count
        return or_infinite(jnp.where(jnp.any(counts), distance, 0))

    return loss
