"""Using a measurement in part: the share g of what it would do to the estimate.

Where the whole measurement moves the mean by K nu and the covariance by -K S K', the share g of it
does g times as much. That is exactly the update of a measurement whose innovation covariance is
S / g; for an information matrix and vector, of one whose noise covariance is R / g.
"""

from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from ewif_jax import checks
from ewif_jax.recursions import information
from ewif_jax.recursions.information import InformationState
from ewif_jax.types import Estimator, Info, Measurement, Params, PyTree, State


def prepared(state: State) -> Any:
    """A first state with room for the shares of the measurements that it stores, if it does."""
    if not hasattr(state, "shares"):
        return state
    slots = state.buffer.time.shape[0] + 1
    return state._replace(shares=jnp.ones(slots, state.buffer.time.dtype))


def partly(estimator: Estimator, share: Array) -> Estimator:
    """The estimator that uses `share`, in [0, 1], of every measurement; its log likelihoods are
    `share` times as large. Its states are `prepared`."""

    def update(params: Params, state: State, measurement: Measurement) -> tuple[Any, Info]:
        if hasattr(state, "shares"):  # stored with the measurement, and used whenever it is
            marked = state._replace(shares=state.shares.at[-1].set(share))
            return estimator.update(params, marked, measurement)
        if hasattr(state, "share"):  # does it itself, with what it keeps of the measurement
            marked = state._replace(share=share)
            updated, info = estimator.update(params, marked, measurement)
            updated = updated._replace(share=state.share)
        else:
            updated, info = estimator.update(params, state, measurement)
            updated = _mixed_states(state, updated, share)
        return updated, info._replace(log_likelihood=share * info.log_likelihood)

    init, predict, _, estimate = estimator[:4]
    return Estimator(init, predict, update, estimate, model=estimator.model)


def _mixed_states(old: PyTree, new: PyTree, share: Array) -> Any:
    """(1 - share) old + share new, in what makes up the estimate."""
    if isinstance(old, InformationState):
        return information.blended(old, new, share)
    plain = hasattr(old, "mean") and hasattr(old, "cov")
    checks.require(
        plain, "softness", "an estimator with means and a covariance as state", type(old).__name__
    )
    # P - g K S K' = (1 - g) P + g (P - K S K'): a mixture of two covariances, so it is one.
    mean, cov = _mix_leaves((old.mean, old.cov), (new.mean, new.cov), share)
    return new._replace(mean=mean, cov=cov)


def _mix_leaves(old: PyTree, new: PyTree, share: Array) -> Any:
    return jax.tree.map(lambda a, b: a + share * (b - a), old, new)
