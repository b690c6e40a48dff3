"""Using late measurements up to a limit of their delay."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ewif_jax import checks
from ewif_jax.models import resolve
from ewif_jax.recipe import from_recipe
from ewif_jax.recursions.contract import offered
from ewif_jax.recursions.partial_use import partly, prepared
from ewif_jax.types import (
    Estimator,
    Gaussian,
    Info,
    Measurement,
    Numbers,
    Parameter,
    Params,
    RandomKey,
    State,
)


@from_recipe
def selective(estimator: Estimator, max_delay: Parameter, softness: Parameter = None) -> Estimator:
    r"""The estimator that uses a late measurement only if it is fresh enough.

    .. math::
        t_e - t_d < T_d

    with :math:`t_e` the state's time and :math:`T_d` = `max_delay`: Algorithm 2 of Yoder et al.
    What is in sequence is always used; the rest leaves the state unchanged, status `TOO_LATE`.

    Args:
        estimator: any `Estimator` that uses late measurements.
        max_delay: seconds, >= 0, a number or a function of `params`.
        softness: seconds, > 0, a number or a function of `params`: replaces the cut-off, whose
            derivative is zero, by the weight
            :math:`g = \sigma((T_d - \text{delay}) / \text{softness})`, 1 in sequence. A measurement
            that would move the estimate by K nu and its covariance by -K S K' then does g times
            as much, which is

            * for a mean and a covariance (`al1`, `bl1`, ...) and for those of several times
              together (`asd`): exactly the update whose innovation covariance is S / g, that is
              R + (1/g - 1) S in place of R;
            * for an information matrix and vector (`ewif`): exactly R / g in place of R.

            So a softly gated measurement is a noisier one, and the covariance stays honest. The
            reported log likelihood is g times the measurement's. `replay` stores g with the
            measurement and does the same in its place, whenever it filters again. States of any
            other kind are refused: particles have no such update.

    Reduces to: `drop_late` for max_delay = 0; the estimator itself for an infinite one; the hard
        cut-off as softness goes to 0 (with `asd` and `replay` as long as their room suffices: a
        measurement of weight 0 still takes the place of one).

    Deviations: Algorithm 2 as printed compares time - lastEstTime, negative for late measurements,
        and lets lastEstTime run backwards; (the estimate's time - the measurement's) is meant, and
        the estimate's time never goes back.

    Raises:
        ValueError: max_delay < 0; softness <= 0; `update` of a soft gate on a state of another kind
            than these.
    """
    checks.estimator(estimator)
    if not callable(max_delay):
        checks.at_least("max_delay", max_delay, 0.0)
    if softness is not None and not callable(softness):
        checks.positive_number("softness", softness)

    def init(params: Params, prior: Gaussian | None, t0: Numbers, key: RandomKey = None) -> Any:
        state = estimator.init(params, prior, t0, key)
        return state if softness is None else prepared(state)

    def update(params: Params, state: State, measurement: Measurement) -> tuple[Any, Info]:
        delay = state.time - measurement.time
        limit = checks.at_least("max_delay", resolve(max_delay, params), 0.0)
        checks.require(np.size(limit) == 1, "max_delay", "one number", f"shape {np.shape(limit)}")
        limit = jnp.reshape(limit, ())
        if softness is None:
            fresh = (delay <= 0) | (delay < limit)
            return offered(estimator.update, params, state, measurement, fresh)
        width = checks.positive_number("softness", resolve(softness, params))
        # In sequence exactly 1: the gate speaks of late data only, and a sigmoid of T_d / softness
        # would take a part of every measurement.
        share = jnp.where(delay > 0, jax.nn.sigmoid((limit - delay) / width), 1)
        return partly(estimator, share.astype(state.time.dtype)).update(params, state, measurement)

    predict, estimate = estimator.predict, estimator.estimate
    return Estimator(init, predict, update, estimate, model=estimator.model)
