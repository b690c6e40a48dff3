"""A model made linear around a Gaussian: by sigma points, or by its Jacobians at the mean."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from ewif_jax import checks
from ewif_jax.kernels import cholesky, sigma_points, symmetric
from ewif_jax.kernels.trees import choose
from ewif_jax.models.linearise import predict_state
from ewif_jax.models.model import Model, resolve
from ewif_jax.models.sensor_range import check_sensor
from ewif_jax.recursions.covariance import measure, unseen
from ewif_jax.recursions.innovations import Compared, updated
from ewif_jax.types import Info, Measurement

ROUNDING = 1e-4
"""The largest share of a value that the weights may turn rounding into."""


class SigmaPoints(NamedTuple):
    """Settings of the scaled unscented transform; each a number or a function of `params`."""

    ut_alpha: Any = 1.0
    ut_beta: Any = 0.0
    ut_kappa: Any = 0.0


class Transform(NamedTuple):
    """c = n + lambda, and the covariance weight of the central point."""

    scale: Array
    centre: Array


def transform(points: SigmaPoints, params: Any, n: int, dtype: Any) -> Transform:
    """The weights for n states; refuses settings that `dtype` cannot carry."""
    ut_alpha, ut_beta, ut_kappa = (resolve(x, params) for x in points)
    checks.positive("ut_alpha", ut_alpha)
    checks.finite("ut_beta", ut_beta)
    spread = ut_alpha**2 * (n + ut_kappa)
    known = checks.known(spread)
    if known is not None:
        checks.require(known > 0, "ut_kappa", f"a number above -{n}, minus the states", ut_kappa)
        lost = float(jnp.finfo(dtype).eps) * n / float(known)
        checks.require(
            lost <= ROUNDING,
            "ut_alpha",
            f"sigma points far enough apart for {jnp.dtype(dtype)}, which would lose a share "
            f"{lost:.2g} of every value (take ut_alpha = 1, or float64)",
            ut_alpha,
        )
    scale = jnp.asarray(spread, dtype)
    return Transform(scale, jnp.asarray(2 - n / spread - ut_alpha**2 + ut_beta, dtype))


def view(
    model: Model, params: Any, sensor: Array, t: Array, x: Array
) -> tuple[Callable[[Array], Array], Array]:
    """What the sensor sees as a function of a state (n,), and R (m, m); refuses a bad sensor."""
    check_sensor(model, params, x, sensor, t)
    R = jnp.asarray(model.measurement_cov(params, sensor, t), x.dtype)
    return lambda x: jnp.asarray(model.observe(params, x, sensor, t), x.dtype), R


def flow_around(
    model: Model,
    points: SigmaPoints | None,
    params: Any,
    mean: Array,
    cov: Array,
    t0: Array,
    t1: Array,
    still: int = 0,
) -> tuple[Array, Array, Array]:
    """Mean at t1 (n,), F (n, n), and Q (n, n) plus what F leaves over, of a packed `cov` at t0: of
    all but the last `still` components, which do not move."""
    if points is None:
        return predict_state(model, params, mean[: mean.shape[0] - still], t0, t1)

    def move(x: Array) -> Array:
        return jnp.asarray(model.transition(params, x, t0, t1), x.dtype)

    moved, F, left_over = _regressed(move, lambda x, y: x - y, points, params, mean, cov, still)
    return moved, F, left_over + jnp.asarray(model.process_cov(params, t0, t1), mean.dtype)


def measure_around(
    model: Model,
    points: SigmaPoints | None,
    params: Any,
    mean: Array,
    cov: Array,
    measurement: Measurement,
    still: int = 0,
) -> tuple[Array, Array, Info]:
    """`recursions.covariance.measure` with the measurement's moments by `points`."""
    if points is None:
        return measure(model, params, mean, cov, measurement, still)
    sensor = measurement.sensor
    moving = mean[: mean.shape[0] - still]
    see, R = view(model, params, sensor, measurement.time, moving)

    def apart(x: Array, y: Array) -> Array:
        return model.residual(x, y, sensor)

    predicted, H, left_over = _regressed(see, apart, points, params, mean, cov, still)
    checks.shape("measurement.value", measurement.value, predicted.shape)
    checks.shape("R", R, predicted.shape * 2)
    difference = apart(measurement.value, predicted)
    seen = Compared(difference, unseen(H, still), R + left_over, measurement.mask)
    return updated(model, mean, cov, seen)


def _regressed(
    f: Callable[[Array], Array],
    apart: Callable[[Array, Array], Array],
    points: SigmaPoints,
    params: Any,
    mean: Array,
    cov: Array,
    still: int,
) -> tuple[Array, Array, Array]:
    """Mean, slope and left-over covariance of f of all but the last `still` components of a
    Gaussian. Values are compared through `apart` with the one at the mean, so that angles on both
    sides of a cut have a mean. NaN, without harm to gradients, where a value is not a number.

    The points that are moved along a column of the other components have f of the mean: they spread
    the rest, and each adds to what is left over as the central point does."""
    scale, centre = transform(points, params, mean.shape[0], mean.dtype)
    centre = centre + still / scale
    n = mean.shape[0] - still
    mean, root = mean[:n], cholesky.factor(symmetric.unpack(cov)[:n, :n])
    around = mean[:, None] + sigma_points.offsets(root.lower, scale)
    middle = f(mean)

    def difference(x: Array) -> Array:
        return apart(f(x), middle)

    differences = jax.vmap(difference, in_axes=1, out_axes=1)(around)
    good = jnp.all(jnp.isfinite(differences))
    differences = jnp.where(good, differences, 0)
    shift, slope, left_over = sigma_points.regression(differences, root, scale, centre)
    return choose(good, (middle + shift, slope, left_over), (jnp.nan,) * 3)
