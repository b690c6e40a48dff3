"""Information that several steps without process noise leave, as a thing that composes.

Without process noise a step only moves and fades what was known and adds what it measured, so a
whole stretch of steps is one `Passage` and one `InformationState`, and stretches add up with no
inverse.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import Array

from ewif_jax.fast.small import matmul, matvec
from ewif_jax.fast.sparse import dense
from ewif_jax.kernels.growth import grown
from ewif_jax.models.linearise import affine_flow
from ewif_jax.models.model import Model
from ewif_jax.recursions.information import InformationState, moved
from ewif_jax.recursions.sighting import still_at_once
from ewif_jax.types import DTypeLike, Params


class Passage(NamedTuple):
    """What happens to old information: x moves on to ahead x + offset and back by `back`
    (both (n, n)), and variances count `growth` () as much."""

    ahead: Array
    offset: Array
    back: Array
    growth: Array


def passage(
    model: Model,
    params: Params,
    growing: Callable[[Any, Array, Array], Array],
    t0: Array,
    t1: Array,
    dtype: DTypeLike,
) -> Passage:
    """The passage from t0 to t1; growing(params, t0, t1) is the factor on the variances."""
    F, c = affine_flow(model, params, t0, t1, dtype)
    back, _ = affine_flow(model, params, t1, t0, dtype)
    F, back = (dense(still_at_once(x, t0 == t1)) for x in (F, back))
    offset = jnp.zeros(F.shape[0], dtype) if c is None else c
    return Passage(F, offset, back, jnp.asarray(growing(params, t0, t1), dtype))


def standstill(n: int, dtype: DTypeLike) -> Passage:
    """The passage that changes nothing."""
    eye = jnp.eye(n, dtype=dtype)
    return Passage(eye, jnp.zeros(n, dtype), eye, jnp.ones((), dtype))


def both_passages(first: Passage, second: Passage) -> Passage:
    """Both, one after the other."""
    return Passage(
        matmul(second.ahead, first.ahead),
        matvec(second.ahead, first.offset) + second.offset,
        matmul(first.back, second.back),
        grown(first.growth, second.growth),
    )


def carried_over(state: InformationState, over: Passage, to: Array) -> InformationState:
    """The state after the passage, at time `to`."""
    mean = matvec(over.ahead, state.mean) + over.offset
    faded = state._replace(time=to, variances=grown(state.variances, over.growth))
    return moved(faded, over.ahead, over.back)._replace(mean=mean)
