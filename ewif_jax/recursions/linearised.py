"""What an information filter makes of a nonlinear model: straight lines around its mean."""

from collections.abc import Callable
from typing import Literal

import jax
import jax.numpy as jnp
from jax import Array

from ewif_jax import checks
from ewif_jax.fast.small import matmul
from ewif_jax.fast.sparse import dense
from ewif_jax.kernels import cholesky, equations, sigma_points
from ewif_jax.kernels.growth import Fade
from ewif_jax.kernels.trees import choose
from ewif_jax.models import Model, predict_measurement
from ewif_jax.models.angles import state_difference
from ewif_jax.recursions.information import InformationState, determined, moved
from ewif_jax.recursions.sighting import Sight
from ewif_jax.recursions.sigma_points import SigmaPoints, regressed_line, view
from ewif_jax.types import Measurement, Params

Linearisation = Literal["extended", "sigma-points"]
"""The tangent at the mean, or the regression of 2n points of the covariance (cubature)."""


def transport_around(
    kind: Linearisation,
    model: Model,
    params: Params,
    state: InformationState,
    time: Array,
    fade: Fade | None,
) -> InformationState:
    """`information.transport` of a nonlinear model, in either direction.

    The reference moves along the motion, what is known around it along the motion's slope. Sigma
    points are those of the state before it fades; what their line leaves over is added like process
    noise.
    """
    is_still = time == state.time

    def move(x: Array) -> Array:
        return jnp.asarray(model.transition(params, x, state.time, time), x.dtype)

    def move_back(x: Array) -> Array:
        return jnp.asarray(model.transition(params, x, time, state.time), x.dtype)

    there, ahead = move(state.mean), jax.jacfwd(move)(state.mean)
    checks.shape("F", ahead, (state.mean.shape[0],) * 2)
    back, noise = jax.jacfwd(move_back)(there), None
    if kind == "sigma-points":
        shifted, line = _line_around(move, lambda a, b: state_difference(model, a, b), state)
        is_known = determined(state)
        there = jnp.where(is_known, shifted, there)
        ahead = jnp.where(is_known, _slope_along_axes(line.slope, state), ahead)
        noise = jnp.where(is_known, cholesky.factor(line.left_over).lower, 0)
    variances = state.variances if fade is None else fade(state.variances)
    faded = state._replace(time=time, mean=there, variances=variances)
    return choose(is_still, state, moved(faded, ahead, back, noise))


def sight_around(
    kind: Linearisation,
    model: Model,
    params: Params,
    state: InformationState,
    measurement: Measurement,
    growth: Array,
) -> Sight:
    """`sighting.sight` of a nonlinear model: a measurement of any time as one of the present state,
    with what the straight line leaves over added to an R that is yet to be multiplied by `growth`;
    NaN where it is no number."""
    now, (time, value, sensor, mask) = state.time, measurement

    def carry(x: Array) -> Array:
        there = jnp.asarray(model.transition(params, x, now, time), x.dtype)
        return jnp.where(time == now, x, there)

    A = jax.jacfwd(carry)(state.mean)
    predicted, H, R = predict_measurement(model, params, carry(state.mean), sensor, time)
    seen, size = matmul(dense(H), A), matmul(jnp.abs(dense(H)), jnp.abs(A))
    if kind == "sigma-points":
        see, _ = view(model, params, sensor, time, state.mean)
        around, line = _line_around(
            lambda x: see(carry(x)), lambda a, b: model.residual(a, b, sensor), state
        )
        is_known = determined(state)
        predicted = jnp.where(is_known, around, predicted)
        seen = jnp.where(is_known, _slope_along_axes(line.slope, state), seen)
        size = jnp.where(is_known, jnp.abs(seen), size)
        R = R + jnp.where(is_known, line.left_over, 0) / growth
    checks.shape("measurement.value", value, (R.shape[0],))
    difference = jnp.where(mask, model.residual(value, predicted, sensor), 0)
    seen = jnp.where(mask[:, None], seen, 0)
    good = jnp.all(jnp.isfinite(difference))
    return Sight(jnp.where(good, seen, jnp.nan), difference, R, jnp.where(mask[:, None], size, 0))


def _line_around(
    f: Callable[[Array], Array], apart: Callable[[Array, Array], Array], state: InformationState
) -> tuple[Array, sigma_points.Regression]:
    """Mean and straight line of f of the state, by cubature points; of unit variances instead while
    something is unknown. Where a value is no number the mean is NaN, and the line nothing.

    The root of the covariance is T^-1 diag(sqrt(variances)): exact however vague, no factor needed.
    """
    spreads = jnp.sqrt(jnp.where(determined(state), state.variances, 1))
    root = equations.inverse(state.rows) * spreads[None]
    value, line = regressed_line(f, apart, SigmaPoints(), None, state.mean, root)
    # One NaN is enough to refuse by: others would reach gradients through what they multiply.
    good = jnp.all(jnp.isfinite(value))
    return value, jax.tree.map(lambda x: jnp.where(good, x, 0), line)


def _slope_along_axes(slope: Array, state: InformationState) -> Array:
    """A slope (m, n) along the columns of the root, along the axes: zero where nothing varies."""
    some = state.variances > 0
    scales = jnp.where(some, jax.lax.rsqrt(jnp.where(some, state.variances, 1)), 0)
    return matmul(slope * scales[None], equations.upper(state.rows))
