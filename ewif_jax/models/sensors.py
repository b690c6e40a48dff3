"""What sensors see. Every kinematic state begins with the position, so a sensor fits any."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from ewif_jax import checks
from ewif_jax.fast.compiling import array
from ewif_jax.fast.sparse import Pattern, pattern
from ewif_jax.models import domain
from ewif_jax.models.parameters import resolve
from ewif_jax.models.tables import select
from ewif_jax.recipe import FromRecipe, from_recipe
from ewif_jax.types import Parameter, Params


class _SensorFields(NamedTuple):
    observe: Callable[..., Array]
    cov: Callable[..., Array]
    angle: tuple[bool, ...]
    matrix: Callable[[int], np.ndarray] | None = None


class Sensor(FromRecipe, _SensorFields):
    """One sensor: observe(params, x, t) -> (m,), cov(params, t) -> (m, m), which of its m
    components are angles, and matrix(n) -> (m, n) if it is linear."""


@from_recipe
def position_sensor(r: Parameter, dims: int = 1) -> Sensor:
    """A sensor of the first `dims` state components (the position).

    Args:
        r: noise variance in m^2, a number, a matrix (dims, dims), or a function of `params`.
        dims: number of space dimensions.
    """
    checks.whole("dims", dims, 1)

    def observe(params: Params, x: Array, t: Array) -> Array:
        return x[:dims]

    return Sensor(observe, _sensor_covariance(r, dims), (False,) * dims, lambda n: np.eye(dims, n))


@from_recipe
def bearing_sensor(r: Parameter, position: Sequence[float] = (0.0, 0.0)) -> Sensor:
    r"""A sensor of the direction to the target, :math:`\mathrm{atan2}(y - y_s, x - x_s)`, radians.

    Args:
        r: noise variance in rad^2, a number or a function of `params`.
        position: (x_s, y_s) in m.

    Deviations: Pornsarayouth & Yamakita (55) leaves the sensor position out. At the sensor itself
    the bearing is undefined: 0 with a zero gradient.
    """
    checks.shape("position", position, (2,))
    checks.finite("position", position)

    def observe(params: Params, x: Array, t: Array) -> Array:
        east, north = x[0] - position[0], x[1] - position[1]
        here = (east == 0) & (north == 0)
        return jnp.arctan2(jnp.where(here, 0, north), jnp.where(here, 1, east))[None]

    return Sensor(observe, _sensor_covariance(r, 1), (True,))


def wrap_angle(angle: Array) -> Array:
    """The same direction in (-pi, pi]; NaN where the dtype does not resolve turns any more."""
    # An angle within (-pi, pi] stays what it is to the last bit, however small.
    wrapped = angle - 2 * jnp.pi * jnp.ceil((angle - jnp.pi) / (2 * jnp.pi))
    return jnp.where(jnp.abs(wrapped) <= 4, wrapped, jnp.nan)


def _sensor_covariance(r: Parameter, m: int) -> Callable[..., Array]:
    if not callable(r):
        if np.ndim(r) == 2:
            checks.psd("r", r)
            checks.shape("r", r, (m, m))
        else:
            domain.check_variance("r", r)

    def cov(params: Params, t: Array) -> Array:
        value = resolve(r, params)
        if np.ndim(value) == 2:
            checks.shape("r", value, (m, m))
            return domain.covariance("r", value)
        value = domain.floating(domain.variance("r", value, params))
        # NumPy's eye: JAX's is a program, compiled where something known is asked inside a trace.
        return value * np.eye(m, dtype=value.dtype)

    return cov


def bank(
    sensors: Sensor | Sequence[Sensor],
) -> tuple[Callable[..., Array], Callable[..., Array], Callable[..., Array], Callable | None, int]:
    """observe, cov, residual and (if all are linear) matrix of sensors chosen by their index:
    matrix(n) -> H(params, sensor, t), and where any H differs from zero.

    All sensors must have the same number of components. Returns the count last.
    """
    group = (sensors,) if isinstance(sensors, Sensor) else tuple(sensors)
    checks.require(len(group) > 0, "sensors", "at least one sensor", "none")
    sizes = {len(s.angle) for s in group}
    checks.require(len(sizes) == 1, "sensors", "equal numbers of components", sorted(sizes))
    angles = np.asarray([s.angle for s in group])

    def choose(values: list[Array], index: Array) -> Any:
        if len(values) == 1:
            return values[0]
        is_concrete = not isinstance(index, Array) and not any(isinstance(x, Array) for x in values)
        if not is_concrete:
            return select(jnp.stack(values), index)
        return np.stack(values)[np.minimum(index, len(values) - 1)]  # refused elsewhere, by name

    def observe(params: Params, x: Array, sensor: Array, t: Array) -> Array:
        return choose([s.observe(params, x, t) for s in group], sensor)

    def cov(params: Params, sensor: Array, t: Array) -> Array:
        return choose([s.cov(params, t) for s in group], sensor)

    def residual(value: Array, predicted: Array, sensor: Array) -> Array:
        difference = value - predicted
        if not angles.any():
            return difference
        wrapped = wrap_angle(difference)
        if angles.all():
            return wrapped
        return jnp.where(jnp.asarray(angles)[sensor], wrapped, difference)

    matrices = [s.matrix for s in group]
    if any(matrix is None for matrix in matrices):
        return observe, cov, residual, None, len(group)

    def matrix(n: int) -> tuple[Callable[..., Array], Pattern]:
        matrices_here = [m(n) for m in matrices if m is not None]
        table = [array(m) for m in matrices_here]
        return (lambda params, sensor, t: choose(table, sensor)), pattern(*matrices_here)

    return observe, cov, residual, matrix, len(group)
