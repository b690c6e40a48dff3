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
from ewif_jax.kernels import symmetric
from ewif_jax.models.linearise import affine_flow
from ewif_jax.models.model import Model
from ewif_jax.recursions.information import InformationState


class Passage(NamedTuple):
    """What happens to old information: x moves on to ahead x + offset and back by `back`
    (both (n, n)), and information counts `weight` () as much."""

    ahead: Array
    offset: Array
    back: Array
    weight: Array


def passage(
    model: Model,
    params: Any,
    squared: Callable[[Any, Array, Array], Array],
    t0: Array,
    t1: Array,
    dtype: Any,
) -> Passage:
    """The passage from t0 to t1; squared(params, t0, t1) is the factor on the information."""
    F, c = affine_flow(model, params, t0, t1, dtype)
    back, _ = affine_flow(model, params, t1, t0, dtype)
    offset = jnp.zeros(F.shape[0], dtype) if c is None else c
    return Passage(F, offset, back, jnp.asarray(squared(params, t0, t1), dtype))


def standstill(n: int, dtype: Any) -> Passage:
    """The passage that changes nothing."""
    eye = jnp.eye(n, dtype=dtype)
    return Passage(eye, jnp.zeros(n, dtype), eye, jnp.ones((), dtype))


def then(first: Passage, second: Passage) -> Passage:
    """Both, one after the other."""
    return Passage(
        matmul(second.ahead, first.ahead),
        matvec(second.ahead, first.offset) + second.offset,
        matmul(first.back, second.back),
        first.weight * second.weight,
    )


def carried(state: InformationState, over: Passage, to: Array) -> InformationState:
    """The state after the passage, at time `to`."""
    return InformationState(
        to,
        matvec(over.ahead, state.mean) + over.offset,
        over.weight * symmetric.congruence(over.back.T, state.matrix),
        over.weight * matvec(over.back.T, state.vector),
    )


def joined(a: InformationState, b: InformationState) -> InformationState:
    """The information of two states of one time together, around a's mean if `a` determines one
    (else around b's), which keeps the vector short."""
    _, determined = symmetric.inverse(a.matrix)
    mean = jnp.where(determined, a.mean, b.mean)
    shifted = [s.vector + symmetric.times(s.matrix, s.mean - mean) for s in (a, b)]
    return a._replace(mean=mean, matrix=a.matrix + b.matrix, vector=shifted[0] + shifted[1])
