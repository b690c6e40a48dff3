"""An estimator whose predictions are made some arrivals ahead."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from ewif_jax.arrival import arrive
from ewif_jax.kernels.trees import choose
from ewif_jax.recipe import from_recipe
from ewif_jax.types import Estimator, Gaussian, Info, Measurement, Numbers, Params, RandomKey, State


class AheadState(NamedTuple):
    """time (), inner: the filter that has seen all but the newest arrivals, and those arrivals."""

    time: Array
    inner: Any
    waiting: Measurement


@from_recipe
def ahead(estimator: Estimator, arrivals: int, width: int) -> Estimator:
    """The estimator, whose `Info` says how it predicted each measurement from those that came
    `arrivals` or more before it.

    The estimate reported is that of the filter which has seen no more.

    Args:
        estimator: any `Estimator`.
        arrivals: 1 is the estimator itself.
        width: the number of components of a measurement.
    """

    def init(params: Params, prior: Gaussian | None, t0: Numbers, key: RandomKey = None) -> Any:
        inner = estimator.init(params, prior, jnp.asarray(t0), key)
        count = arrivals - 1
        waiting = Measurement(
            jnp.broadcast_to(inner.time, (count,)),
            jnp.zeros((count, width), inner.time.dtype),
            jnp.zeros(count, jnp.int32),
            jnp.zeros((count, width), bool),
        )
        return AheadState(inner.time, inner, waiting)

    def predict(params: Params, state: AheadState, time: Array) -> AheadState:
        del params
        return state._replace(time=time)

    def update(
        params: Params, state: AheadState, measurement: Measurement
    ) -> tuple[AheadState, Info]:
        # The filter inside meets the newest measurement only to say how it predicted it; what it
        # keeps is the oldest of those that wait. So every rule of arrivals holds for both.
        info = arrive(estimator, params, state.inner, measurement).info
        oldest = jax.tree.map(lambda x: x[0], state.waiting)
        inner = arrive(estimator, params, state.inner, oldest).kept
        waiting = jax.tree.map(
            lambda old, new: jnp.concatenate([old[1:], jnp.asarray(new, old.dtype)[None]]),
            state.waiting,
            measurement,
        )
        present = jnp.any(measurement.mask)
        moved = AheadState(state.time, inner, waiting)
        delay = state.time - measurement.time
        return choose(present, moved, state), info._replace(delay=delay)

    def estimate(params: Params, state: State) -> Gaussian:
        inner = state.inner
        reached = estimator.predict(params, inner, jnp.maximum(inner.time, state.time))
        return estimator.estimate(params, reached)

    if arrivals == 1:
        return estimator
    return Estimator(init, predict, update, estimate, model=estimator.model)
