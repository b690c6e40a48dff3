"""Refusing measurements that are too far from what is expected, without locking the filter out."""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.scipy.special import gammaincc

from ewif_jax import checks
from ewif_jax.kernels import gaussian
from ewif_jax.models import resolve
from ewif_jax.recipe import from_recipe
from ewif_jax.recursions.contract import is_used, let_through
from ewif_jax.types import (
    Estimator,
    Gaussian,
    Info,
    Measurement,
    Numbers,
    Parameter,
    Params,
    RandomKey,
)


class GatedState(NamedTuple):
    """time (), current: the state of the filter behind the gate, outside () int32: how many
    measurements in a row were outside of the gate, counted up to `recover_after`."""

    time: Array
    current: Any
    outside: Array


@from_recipe
def gated(
    estimator: Estimator, probability: Parameter = 0.999, recover_after: int | None = 5
) -> Estimator:
    r"""The estimator that refuses measurements outside of a chi-square gate.

    .. math::
        \nu' S^{-1} \nu > \chi^2_m(p)

    with p = `probability` and m the number of components that are present: of a measurement that
    the model is right about, the share 1 - p is refused. Refused means `REJECTED`: the state does
    not change, the log likelihood is 0, and `Info` has the :math:`\nu` and S that the gate judged.
    A late measurement is judged by its innovation at its own time.

    **Recovery.** A filter that is wrong, and too sure of itself, would refuse everything from then
    on. So the gate opens once `recover_after` = k measurements in a row were outside of it: what
    comes next is used, inside or not, until one is inside, which closes the gate again. If a share
    :math:`\varepsilon` of the measurements are outliers that fall independently of each other, one
    is outside with probability :math:`s = \varepsilon + (1 - \varepsilon)(1 - p)`, and

    * a measurement is wrongly used, because k before it were outside too, with probability at most
      :math:`s^{k+1}`: for k = 5 one in 58 million at :math:`\varepsilon` = 5 %, one in 940,000 at
      10 %, one in 15,000 at 20 %;
    * outliers that are not k + 1 in a row never pass;
    * a filter that everything contradicts loses k measurements.

    A filter that works is refused k in a row with probability :math:`(1 - p)^k` a measurement,
    :math:`10^{-15}` by default: so a run of k is evidence against the filter, not against the data.
    A sensor that is refused while others are used counts as broken, not as lock-out.

    Args:
        estimator: any `Estimator`.
        probability: p in (0, 1], a number or a function of `params`; 1 refuses nothing. The gate is
            yes or no: its derivative is 0.
        recover_after: k >= 1, or None: the gate never opens.

    Nothing is refused while the estimator knows too little to predict (`prior=None`). What the
    estimator does not use itself (`TOO_LATE`, not a number) counts for nothing. `replay(gated(e))`
    judges anew whenever it filters again, as if all had come in order; `gated(replay(e))` judges
    once, on arrival. The covariance of `ewif` is that of the error only if the model fits; a gate
    on it is as wide as the covariance says.

    Reduces to: the estimator itself for probability 1; the estimator run without the outliers
        where each of these is outside.

    Raises:
        ValueError: `probability` is not in (0, 1]; recover_after < 1.
    """
    checks.estimator(estimator)
    if not callable(probability):
        _check_probability(probability)
    patience = None if recover_after is None else checks.whole("recover_after", recover_after, 1)

    def init(params: Params, prior: Gaussian | None, t0: Numbers, key: RandomKey = None) -> Any:
        _check_probability(resolve(probability, params))
        first = estimator.init(params, prior, t0, key)
        return GatedState(first.time, first, jnp.zeros((), jnp.int32))

    def predict(params: Params, state: GatedState, time: Array) -> GatedState:
        moved = estimator.predict(params, state.current, time)
        return state._replace(time=moved.time, current=moved)

    def update(
        params: Params, state: GatedState, measurement: Measurement
    ) -> tuple[GatedState, Info]:
        updated, info = estimator.update(params, state.current, measurement)
        level = _check_probability(resolve(probability, params))
        judged = is_used(info)
        # What the filter would not have used is no evidence, neither for it nor against it.
        outside = judged & _is_outside(info, measurement.mask, level)
        is_open = False if patience is None else state.outside >= patience
        current, info = let_through(~outside | is_open, state.current, updated, info)
        counted = jnp.minimum(state.outside + 1, 0 if patience is None else patience)
        counted = jnp.where(outside, counted, jnp.where(judged, 0, state.outside))
        return GatedState(current.time, current, counted), info

    def estimate(params: Params, state: GatedState) -> Gaussian:
        return estimator.estimate(params, state.current)

    return Estimator(init, predict, update, estimate, model=estimator.model)


def _is_outside(info: Info, mask: Array, level: Numbers) -> Array:
    """Whether the innovation is outside of the gate; not if it is not known, () bool."""
    innovation, cov = lax.stop_gradient((info.innovation, info.innovation_cov))
    distance = gaussian.squared_distance(innovation, cov)
    count = jnp.sum(mask)
    fixed_level = checks.concrete_value(level)
    if fixed_level is None:
        tail = gammaincc(count.astype(distance.dtype) / 2, distance / 2)
        return tail < 1 - lax.stop_gradient(level)
    quantiles = _quantiles(mask.shape[0], float(fixed_level))
    return distance > jnp.asarray(quantiles, distance.dtype)[count]


def _quantiles(most: int, level: float) -> np.ndarray:
    """The chi-square quantiles at `level` for 0, 1, ..., `most` degrees of freedom."""
    from scipy.special import gammaincinv  # here: the import takes longer than the call

    return 2 * gammaincinv(np.arange(most + 1) / 2, level)


def _check_probability(level: Numbers) -> Any:
    checks.shape("probability", level, ())
    value = checks.concrete_value(level)
    if value is not None:
        inside = bool((value > 0) & (value <= 1))
        checks.require(inside, "probability", "a number in (0, 1]", level)
    return level
