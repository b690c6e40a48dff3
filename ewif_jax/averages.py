"""From the scores of rows to one number: what the losses have in common."""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array

from ewif_jax import checks
from ewif_jax.charges import WIDTH
from ewif_jax.charging import Charging, Rows, Unused, value_charging
from ewif_jax.scores import Score, average
from ewif_jax.types import Estimator, Measurement, Numbers, Params

Loss = Callable[..., Array]


def averaged(
    charging: Charging, truth: Numbers, score: Score, finish: Callable[[Array], Array]
) -> Loss:
    """params -> what `finish` makes of the mean score."""

    def loss(params: Params) -> Array:
        return or_infinite(finish(mean_of(charging.scored(params, truth, score))))

    return loss


def consistency_of(charging: Charging, truth: Numbers, score: Score) -> Loss:
    """params -> squared log of the mean of a score that should be 1."""

    def loss(params: Params) -> Array:
        values = charging.raw(params, truth, score)
        if charging.unused == "leave out":
            return or_infinite(_squared_log(average(values)))
        charge = jnp.broadcast_to(jnp.asarray(charging.charge(params)), values.shape)
        counted = ~jnp.isnan(charge)
        values = jnp.where(counted, values, jnp.nan)
        rows, answered = jnp.sum(counted), jnp.sum(~jnp.isnan(values))
        share, silent = (
            x.astype(values.dtype) / jnp.maximum(rows, 1).astype(values.dtype)
            for x in (answered, rows - answered)
        )
        seen = _squared_log(jnp.where(answered > 0, mean_of(values), 1))
        return or_infinite(share * seen + silent * _WIDE)

    return loss


_WIDE = float(np.log(WIDTH**2) ** 2)


def of_predictions(
    estimator: Estimator,
    measurements: Measurement,
    setting: dict[str, Any],
    unused: Unused,
    rows: Rows,
    ahead: Numbers,
    cost: Callable[..., Any],
    finish: Callable[[Charging], Loss],
) -> Loss:
    """What `finish` makes of predictions `ahead`, whose rows cost `cost` where they are missing."""

    def build(horizon: int) -> Loss:
        some = rows._replace(ahead=horizon)
        return finish(value_charging(estimator, measurements, cost, unused, setting, some))

    return over_horizons(ahead, build)


def over_horizons(ahead: Numbers, build: Callable[[int], Loss]) -> Loss:
    """The loss of one horizon, or the mean of those of several."""
    if np.ndim(ahead) == 0:
        return build(checks.whole("ahead", ahead, 1))
    checks.require(len(ahead) > 0, "ahead", "at least one horizon", "none")
    every = [build(checks.whole("ahead", k, 1)) for k in ahead]

    def loss(params: Params) -> Array:
        return sum((one(params) for one in every[1:]), every[0](params)) / len(every)

    return loss


def mean_of(values: Array) -> Array:
    """The mean of what is not NaN; 0 of nothing."""
    is_score = ~jnp.isnan(values)
    count = jnp.maximum(jnp.sum(is_score), 1).astype(values.dtype)
    return jnp.sum(jnp.where(is_score, values, 0)) / count


def itself(x: Array) -> Array:
    """What it is given."""
    return x


def root_of(x: Array) -> Array:
    """The root, with derivative 0 at 0: where no error is left there is nothing to tune."""
    return jnp.where(x > 0, jnp.sqrt(jnp.where(x > 0, x, 1)), x)


def _squared_log(ratio: Array) -> Array:
    tiny = jnp.finfo(ratio.dtype).tiny
    return jnp.square(jnp.log(jnp.where(ratio < tiny, tiny, ratio)))


def or_infinite(loss: Array) -> Array:
    """Infinity in place of NaN."""
    return jnp.where(jnp.isnan(loss), jnp.inf, loss)
