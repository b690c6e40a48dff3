"""Using late measurements up to a limit of their delay."""

from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from ewif_jax import checks
from ewif_jax.estimator import choose
from ewif_jax.forms import information
from ewif_jax.forms.information import InformationState
from ewif_jax.kernels.small import matmul, matvec
from ewif_jax.models import resolve
from ewif_jax.oosm.history import too_late
from ewif_jax.types import Estimator, Info, Measurement


def selective(estimator: Estimator, max_delay: Any, softness: Any = None) -> Estimator:
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
            reported log likelihood is g times the measurement's. States of any other kind are
            refused: `replay` repeats what it has stored, which has no weight, and particles have
            no such update.

    Reduces to: `drop_late` for max_delay = 0; the estimator itself for an infinite one; the hard
        cut-off as softness goes to 0 (with `asd` as long as its past times suffice: a measurement
        of weight 0 still takes the place of one).

    Deviations: Algorithm 2 as printed compares time - lastEstTime, negative for late measurements,
        and lets lastEstTime run backwards; (the estimate's time - the measurement's) is meant, and
        the estimate's time never goes back.

    Raises:
        ValueError: max_delay < 0; softness <= 0; `update` of a soft gate on a state of another kind
            than these.
    """
    kind = type(estimator).__name__
    checks.require(isinstance(estimator, Estimator), "estimator", "an Estimator", kind)
    if not callable(max_delay):
        checks.at_least("max_delay", max_delay, 0.0)
    if softness is not None and not callable(softness):
        checks.positive("softness", softness)

    def update(params: Any, state: Any, measurement: Measurement) -> tuple[Any, Info]:
        delay = state.time - measurement.time
        limit = checks.at_least("max_delay", resolve(max_delay, params), 0.0)
        updated, info = estimator.update(params, state, measurement)
        if softness is None:
            stale = (delay > 0) & (delay >= limit)
            return choose(stale, state, updated), too_late(info, stale)
        width = checks.positive("softness", resolve(softness, params))
        weight = jnp.where(delay > 0, jax.nn.sigmoid((limit - delay) / width), 1)
        weight = weight.astype(state.time.dtype)
        info = info._replace(log_likelihood=weight * info.log_likelihood)
        if hasattr(updated, "means"):
            return _weakened(estimator, params, state, measurement, weight), info
        return _mixed(state, updated, weight), info

    return estimator._replace(update=update)


def _weakened(
    estimator: Estimator, params: Any, state: Any, measurement: Measurement, weight: Array
) -> Any:
    """The joint state with `weight` times the effect of the measurement, not of making room for its
    time. The gain is the derivative of the new means."""

    def means(value: Array) -> tuple[Array, tuple[Any, Info]]:
        updated, info = estimator.update(params, state, measurement._replace(value=value))
        return updated.means.reshape(-1), (updated, info)

    gain, (updated, info) = jax.jacfwd(means, has_aux=True)(measurement.value)
    back = matvec(gain, info.innovation).reshape(updated.means.shape)
    spread = matmul(matmul(gain, info.innovation_cov), gain.T)
    return updated._replace(
        means=updated.means - (1 - weight) * back, cov=updated.cov + (1 - weight) * spread
    )


def _mixed(old: Any, new: Any, weight: Array) -> Any:
    """(1 - weight) old + weight new, in what makes up the estimate."""
    if isinstance(old, InformationState):
        shifted = new.vector + information.times(new.matrix, new.mean - old.mean)
        matrix, vector = _mix((old.matrix, old.vector), (new.matrix, shifted), weight)
        return information.recentred(old._replace(matrix=matrix, vector=vector))
    plain = hasattr(old, "mean") and hasattr(old, "cov")
    checks.require(
        plain, "softness", "an estimator with means and a covariance as state", type(old).__name__
    )
    mean, cov = _mix((old.mean, old.cov), (new.mean, new.cov), weight)
    return new._replace(mean=mean, cov=cov)


def _mix(old: Any, new: Any, weight: Array) -> Any:
    return jax.tree.map(lambda a, b: a + weight * (b - a), old, new)
