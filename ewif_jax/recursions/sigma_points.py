"""A model made linear around a Gaussian: by sigma points, or by its Jacobians at the mean."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from ewif_jax import checks
from ewif_jax.fast.small import matmul
from ewif_jax.fast.sparse import dense
from ewif_jax.kernels import cholesky, gaussian, sigma_points, symmetric
from ewif_jax.kernels.trees import choose
from ewif_jax.models.angles import state_difference
from ewif_jax.models.linearise import noise_at, predict_state
from ewif_jax.models.model import Model, resolve
from ewif_jax.models.sensor_range import check_sensor
from ewif_jax.recursions.covariance import measure, unseen
from ewif_jax.recursions.innovations import Compared, are_finite, info_of, updated
from ewif_jax.types import DTypeLike, Info, Measurement, Params

ROUNDING = 1e-4
"""The largest share of a value that the weights may turn rounding into."""
MOST = 20_000
"""Points of a quadrature: nine states by three of each."""


class SigmaPoints(NamedTuple):
    """Settings of the scaled unscented transform; each a number or a function of `params`."""

    ut_alpha: Any = 1.0
    ut_beta: Any = 0.0
    ut_kappa: Any = 0.0


class GaussHermite(NamedTuple):
    """`order` points along each axis, in every combination."""

    order: int

    def grid(self, n: int, dtype: DTypeLike) -> tuple[Array, Array]:
        """Points (n, order^n) and weights for n states; refuses more points than anyone wants."""
        count = self.order**n
        checks.require(
            count <= MOST,
            "order",
            f"at most {MOST} points, the order to the power of {n} states (take a smaller order, "
            "or points='unscented': two for each state)",
            f"{self.order}, {count} points",
        )
        points, weights = sigma_points.gauss_hermite(n, self.order)
        return jnp.asarray(points, dtype), jnp.asarray(weights, dtype)


Points = SigmaPoints | GaussHermite
"""Where a function of a Gaussian is looked at."""


class PointWeights(NamedTuple):
    """c = n + lambda, and the covariance weight of the central point."""

    scale: Array
    centre: Array


def check_points(points: Points, params: Params, n: int, dtype: DTypeLike) -> None:
    """Refuses settings that n states or `dtype` cannot carry."""
    if isinstance(points, GaussHermite):
        points.grid(n, dtype)
    else:
        transform(points, params, n, dtype)


def transform(points: SigmaPoints, params: Params, n: int, dtype: DTypeLike) -> PointWeights:
    """The weights for n states; refuses settings that `dtype` cannot carry."""
    ut_alpha, ut_beta, ut_kappa = (resolve(x, params) for x in points)
    checks.positive("ut_alpha", ut_alpha)
    checks.finite("ut_beta", ut_beta)
    spread = ut_alpha**2 * (n + ut_kappa)
    number = checks.concrete_value(spread)
    if number is not None:
        checks.require(number > 0, "ut_kappa", f"a number above -{n}, minus the states", ut_kappa)
        # Weights of order n / spread, of both signs, multiply values that are rounded by eps: with
        # ut_alpha = 1e-3 of the textbooks a tenth of every value is rounding in float32.
        lost = float(jnp.finfo(dtype).eps) * n / float(number)
        checks.require(
            lost <= ROUNDING,
            "ut_alpha",
            f"sigma points far enough apart for {jnp.dtype(dtype)}, which would lose a share "
            f"{lost:.2g} of every value (take ut_alpha = 1, or float64)",
            ut_alpha,
        )
    scale = jnp.asarray(spread, dtype)
    return PointWeights(scale, jnp.asarray(2 - n / spread - ut_alpha**2 + ut_beta, dtype))


def view(
    model: Model, params: Params, sensor: Array, t: Array, x: Array
) -> tuple[Callable[[Array], Array], Array]:
    """What the sensor sees as a function of a state (n,), and R (m, m); refuses a bad sensor."""
    check_sensor(model, params, x, sensor, t)
    R = noise_at(model, params, x, sensor, t)
    return lambda x: jnp.asarray(model.observe(params, x, sensor, t), x.dtype), R


def flow_around(
    model: Model,
    points: Points | None,
    params: Params,
    mean: Array,
    cov: Array,
    t0: Array,
    t1: Array,
    still: int = 0,
) -> tuple[Array, Array, Array]:
    """Mean at t1 (n,), F (n, n), and Q (n, n) plus what F leaves over, of a packed `cov` at t0: of
    all but the last `still` components, which do not move."""
    if points is None or model.linear is not None:
        moved, F, Q = predict_state(model, params, mean[: mean.shape[0] - still], t0, t1)
        return moved, dense(F), Q
    root = _divisible_root(cov, mean.shape[0] - still)
    moved, line = _moved_line(model, points, params, mean, root.lower, t0, t1, still)
    Q = jnp.asarray(model.process_cov(params, t0, t1), mean.dtype)
    return moved, sigma_points.slope_of(line, root), line.left_over + Q


def move_around(
    model: Model, points: Points, params: Params, mean: Array, cov: Array, t0: Array, t1: Array
) -> tuple[Array, Array]:
    """Mean (n,) and packed covariance at t1 of a Gaussian at t0 with a packed `cov`."""
    if model.linear is not None:
        moved, F, Q = predict_state(model, params, mean, t0, t1)
        return moved, symmetric.congruence(F, cov) + symmetric.pack(Q)
    lower = _fine_root(cov, mean.shape[0])
    moved, line = _moved_line(model, points, params, mean, lower, t0, t1)
    Q = jnp.asarray(model.process_cov(params, t0, t1), mean.dtype)
    return moved, symmetric.pack(matmul(line.slope, line.slope.T) + line.left_over + Q)


def measure_around(
    model: Model,
    points: Points | None,
    params: Params,
    mean: Array,
    cov: Array,
    measurement: Measurement,
    still: int = 0,
) -> tuple[Array, Array, Info]:
    """`recursions.covariance.measure` with the measurement's moments by `points`."""
    if points is None or model.linear is not None:
        return measure(model, params, mean, cov, measurement, still)
    n, sensor, mask = mean.shape[0] - still, measurement.sensor, measurement.mask
    see, R = view(model, params, sensor, measurement.time, mean[:n])

    def apart(x: Array, y: Array) -> Array:
        return model.residual(x, y, sensor)

    root = _divisible_root(cov, n) if still else None
    exact = ~cholesky.factor(gaussian.mask_cov(jnp.asarray(R, mean.dtype), mask)).full_rank
    lower = _fine_root(cov, n, exact) if root is None else root.lower
    predicted, line = regressed_line(see, apart, points, params, mean, lower, still)
    checks.shape("measurement.value", measurement.value, predicted.shape)
    checks.shape("R", R, predicted.shape * 2)
    # After an exact measurement the points differ by rounding only, as the members of ensembles do.
    rounding = gaussian.rounding_of(predicted)
    is_spread = jnp.max(jnp.abs(line.slope), 1) > rounding
    is_spread |= jnp.diagonal(line.left_over) > jnp.square(rounding)
    left_over = jnp.where(is_spread[:, None] & is_spread[None], line.left_over, 0)
    difference, R = apart(measurement.value, predicted), R + left_over
    if root is not None:
        H = unseen(sigma_points.slope_of(line, root), still)
        return updated(model, mean, cov, Compared(difference, H, R, mask))
    slope = jnp.where((mask & is_spread)[:, None], line.slope, 0)
    good = are_finite(difference, matmul(slope, slope.T) + R, mask)
    difference, slope, R = (jnp.where(good, x, 0) for x in (difference, slope, R))
    mask = mask & good
    mean, cov, innovation = sigma_points.update_by_points(mean, lower, difference, slope, R, mask)
    return mean, cov, info_of(innovation, mask, good)


def _divisible_root(cov: Array, n: int) -> cholesky.Factor:
    """The factor of the first n components' part of a packed `cov`, to be divided by."""
    return cholesky.factor(symmetric.unpack(cov)[:n, :n])


def _fine_root(cov: Array, n: int, exact: Array | bool = False) -> Array:
    """The factor's lower (n, n), not to be divided by: pivots near rounding are part of it, since a
    position and a velocity of which little is known are correlated almost to one. They are left out
    where an `exact` measurement would weigh them like knowledge."""
    eps = float(jnp.finfo(cov.dtype).eps)
    size = jnp.where(exact, cholesky.negligible(n, cov.dtype) / eps, 1) * symmetric.diagonal(cov)
    return cholesky.factor(symmetric.unpack(cov), eps, size).lower


def _moved_line(
    model: Model,
    points: Points,
    params: Params,
    mean: Array,
    lower: Array,
    t0: Array,
    t1: Array,
    still: int = 0,
) -> tuple[Array, sigma_points.Regression]:
    """Mean at t1, and the motion as a straight line without its noise."""

    def move(x: Array) -> Array:
        return jnp.asarray(model.transition(params, x, t0, t1), x.dtype)

    def apart(x: Array, y: Array) -> Array:
        return state_difference(model, x, y)

    return regressed_line(move, apart, points, params, mean, lower, still)


def regressed_line(
    f: Callable[[Array], Array],
    apart: Callable[[Array, Array], Array],
    points: Points,
    params: Params,
    mean: Array,
    lower: Array,
    still: int = 0,
) -> tuple[Array, sigma_points.Regression]:
    """Mean and straight line of f of all but the last `still` components of a Gaussian, whose
    covariance is `lower` times its transpose. Values are compared through `apart` with the one at
    the mean, so that angles on both sides of a cut have a mean. NaN, without harm to gradients,
    where a value is not a number.

    The points that are moved along a column of the other components have f of the mean: they spread
    the rest, and each adds to what is left over as the central point does."""
    moving = mean[: mean.shape[0] - still]
    middle = f(moving)

    def difference(x: Array) -> Array:
        return apart(f(x), middle)

    def differences(offsets: Array) -> Array:
        return jax.vmap(difference, in_axes=1, out_axes=1)(moving[:, None] + offsets)

    if isinstance(points, GaussHermite):
        grid, weights = points.grid(moving.shape[0], mean.dtype)
        apart_by, good = _numbers_only(differences(matmul(lower, grid)))
        line = sigma_points.quadrature(apart_by, grid, weights)
    else:
        scale, centre = transform(points, params, mean.shape[0], mean.dtype)
        apart_by, good = _numbers_only(differences(sigma_points.offsets(lower, scale)))
        # Each of the 2 `still` points that do not move f has the weight 1 / (2 scale).
        line = sigma_points.regression(apart_by, scale, centre + still / scale)
    found = middle + line.shift, line
    return choose(good, found, jax.tree.map(lambda _: jnp.nan, found))


def _numbers_only(values: Array) -> tuple[Array, Array]:
    """`values`, all zero unless all are finite, and whether they are."""
    good = jnp.all(jnp.isfinite(values))
    return jnp.where(good, values, 0), good
