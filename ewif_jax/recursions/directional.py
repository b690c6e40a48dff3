"""Forgetting in the directions in which measurements come in, and in no other.

With V (m, n) an orthonormal basis of the rows of H, the information of a measurement's directions
is taken apart from the rest, and only it is forgotten (Lai & Bernstein 2024):

    I+ = I - (1 - w) I V' (V I V')^-1 V I

for an information matrix I and the share w that is kept. By the matrix inversion lemma that is

    P+ = P + (1 / w - 1) V' (V I V')^-1 V,

the motion x <- x with process noise in the span of V' alone: `information.moved` adds it to the
equations, and I itself is never formed. With V square it is P / w. Bounds that no data break:
docs/decisions/estimators.md.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from ewif_jax.fast.small import matmul
from ewif_jax.kernels import cholesky, equations, symmetric
from ewif_jax.kernels.growth import largest_variance
from ewif_jax.kernels.trees import choose
from ewif_jax.recursions.contract import Recursion
from ewif_jax.recursions.information import InformationState, absorb_sight, moved
from ewif_jax.recursions.lines import Lines
from ewif_jax.types import Gaussian, Info, Measurement, Params, RandomKey


class DirectionalState(NamedTuple):
    """time (), information: what is known; ages: the upper triangle of A (n, n), of which v'A v
    is for how many seconds the direction v (n,) of unit length has not been forgotten."""

    time: Array
    information: InformationState
    ages: Array


def directional(
    plain: Recursion,
    lines: Lines,
    growing: Callable[[Params, Array, Array], Array],
    decay: Callable[[Params, Array], Array],
) -> Recursion:
    """An information filter that forgets as it moves, as one that forgets where it measures.

    growing(params, t, now) is what the noise of a late measurement counts, decay(params, now) tau.
    """

    def start(
        params: Params, prior: Gaussian | None, t0: Array, key: RandomKey
    ) -> DirectionalState:
        information = plain.init(params, prior, t0, key)
        n = information.mean.shape[0]
        return DirectionalState(
            information.time, information, jnp.zeros(n * (n + 1) // 2, information.mean.dtype)
        )

    def move(params: Params, state: DirectionalState, time: Array) -> DirectionalState:
        information = lines.transport(params, state.information, time, None)
        eye = symmetric.pack(jnp.eye(information.mean.shape[0], dtype=information.mean.dtype))
        return DirectionalState(time, information, state.ages + eye * (time - state.time))

    def measure(
        params: Params, state: DirectionalState, measurement: Measurement
    ) -> tuple[DirectionalState, Info]:
        growth = growing(params, measurement.time, state.time)
        seen = lines.look(params, state.information, measurement, growth).seen
        # A late measurement is added and forgets nothing: what came since has done so.
        fresh = measurement.time >= state.time
        information, ages = forgotten(state, jnp.where(fresh, seen, 0), decay(params, state.time))
        found = lines.look(params, information, measurement, growth)
        information, info = absorb_sight(information, found, measurement, growth)
        return DirectionalState(state.time, information, ages), info

    def estimate(params: Params, state: DirectionalState) -> Gaussian:
        return plain.estimate(params, state.information)

    def reach(params: Params, state: DirectionalState, time: Array) -> Array:
        assert plain.reach is not None
        return plain.reach(params, state.information, time)

    made = Recursion(plain.name, start, move, measure, estimate, reach, model=plain.model)
    return made._replace(moves_back=True, starts_from_nothing=True, inverts_prior=True)


def forgotten(state: DirectionalState, seen: Array, tau: Array) -> tuple[InformationState, Array]:
    """What is known, and the ages, once the directions of the rows of `seen` (m, n) have forgotten
    over theirs; rows of zeros, or that are no numbers, are no directions."""
    information, A = state.information, symmetric.unpack(state.ages)
    V = _basis(jnp.where(jnp.all(jnp.isfinite(seen)), seen, 0))
    across = matmul(V, A)
    age = cholesky.factor(matmul(across, V.T))
    growth = _root_of_growth(jnp.square(jnp.diagonal(age.lower)), tau)
    # V I V' = W W'. Of which nothing is known, there is nothing to forget.
    some = information.variances > 0
    roots = jnp.where(some, 1 / jnp.sqrt(jnp.where(some, information.variances, 1)), 0)
    told = cholesky.factor(_product(matmul(V, equations.upper(information.rows).T) * roots[None]))
    noise = cholesky.forward(told, growth[:, None] * V).T
    eye = jnp.eye(A.shape[0], dtype=A.dtype)
    left = moved(information, eye, eye, noise)
    taken = cholesky.forward(age, across)
    ages = symmetric.pack(A - matmul(taken.T, taken))
    return choose(jnp.any(noise != 0), left, information), ages


def _basis(rows: Array) -> Array:
    """An orthonormal basis (m, n) of the rows (m, n): zero for one that those before it say
    already, to rounding."""
    # Of unit length first, so that units of the sensor are no matter.
    square = jnp.sum(jnp.square(rows), 1, keepdims=True)
    rows = rows * jnp.where(square > 0, 1 / jnp.sqrt(jnp.where(square > 0, square, 1)), 0)
    return cholesky.forward(cholesky.factor(_product(rows)), rows)


def _product(rows: Array) -> Array:
    return matmul(rows, rows.T)


def _root_of_growth(ages: Array, tau: Array) -> Array:
    """sqrt(exp(age / tau) - 1) of ages (m,), with slope 0 at age 0, up to the largest variance."""
    most = float(np.log(largest_variance(ages.dtype)))
    grown = jnp.expm1(jnp.minimum(ages / tau, most))
    some = ages > 0
    return jnp.where(some, jnp.sqrt(jnp.where(some, grown, 1)), 0)
