"""Sensors that look from where they are: ranges, directions, and how fast a range changes.

Where a target is at the sensor itself, these are undefined: 0, with a zero gradient.
"""

from collections.abc import Callable

import jax.numpy as jnp
import numpy as np
from jax import Array

from ewif_jax import checks
from ewif_jax.models.places import Place, motion_of, place_of
from ewif_jax.models.sensors import Sensor, noise_cov
from ewif_jax.recipe import from_recipe
from ewif_jax.types import Parameter, Params

Part = Callable[[Array, Array | None], Array]
"""(target minus sensor (dims,), its velocity minus the sensor's (dims,)) -> ()"""


@from_recipe
def range_sensor(r: Parameter, position: Place = None, dims: int | None = None) -> Sensor:
    r"""A sensor of the distance to the target, :math:`|p - p_s|`.

    Args:
        r: noise variance in m^2, a number or a function of `params`.
        position: p_s: (dims,), or a function (params, t) -> (dims,) for a sensor that moves, or a
            function of `params`. None: the origin.
        dims: number of space dimensions; None: that of a given position, else 2.

    Deviations: at the sensor itself the range is 0 with a zero gradient.
    """
    return _looking(r, position, None, dims, (_range,))


@from_recipe
def range_rate_sensor(
    r: Parameter, position: Place = None, velocity: Place = None, dims: int | None = None
) -> Sensor:
    r"""A sensor of how fast the distance grows (Doppler), :math:`(p - p_s)'(v - v_s) / |p - p_s|`.

    Args:
        r: noise variance in (m/s)^2, a number or a function of `params`.
        position: p_s, as in `range_sensor`.
        velocity: v_s, likewise; None: the derivative of a position that is a function of
            (params, t), else 0.
        dims: as in `range_sensor`. The state lists the velocity after the position.

    Deviations: at the sensor itself the rate is undefined: 0 with a zero gradient.
    """
    return _looking(r, position, velocity, dims, (_range_rate,))


@from_recipe
def bearing_sensor(r: Parameter, position: Place = None, dims: int = 2) -> Sensor:
    r"""A sensor of the direction to the target, :math:`\mathrm{atan2}(y - y_s, x - x_s)`, radians.

    Args:
        r: noise variance in rad^2, a number or a function of `params`.
        position: (x_s, y_s) in m, or a function of (params, t), or of `params`; None: the origin.
        dims: number of space dimensions; of more than two the first two count.

    Deviations: Pornsarayouth & Yamakita (55) leaves the sensor position out. At the sensor itself
    the bearing is undefined: 0 with a zero gradient.
    """
    return _looking(r, position, None, _at_least_two(dims), (_bearing,))


@from_recipe
def range_bearing_sensor(r: Parameter, position: Place = None, dims: int = 2) -> Sensor:
    """A sensor of range and bearing: a radar.

    Args:
        r: noise: a variance for both, variances (m^2, rad^2), (2, 2), or a function of `params`.
        position, dims: as in `bearing_sensor`.

    Deviations: at the sensor itself as `range_sensor` and `bearing_sensor`.
    """
    return _looking(r, position, None, _at_least_two(dims), (_range, _bearing))


@from_recipe
def range_bearing_rate_sensor(
    r: Parameter, position: Place = None, velocity: Place = None, dims: int = 2
) -> Sensor:
    """A sensor of range, bearing and range rate: a Doppler radar.

    Args:
        r: noise: a variance for all, variances (m^2, rad^2, m^2/s^2), (3, 3), or a function of
            `params`.
        position, dims: as in `bearing_sensor`.
        velocity: as in `range_rate_sensor`.

    Deviations: at the sensor itself as `range_sensor`, `bearing_sensor` and `range_rate_sensor`.
    """
    parts = (_range, _bearing, _range_rate)
    return _looking(r, position, velocity, _at_least_two(dims), parts)


@from_recipe
def azimuth_elevation_range_sensor(r: Parameter, position: Place = None, dims: int = 3) -> Sensor:
    r"""A sensor of azimuth :math:`\mathrm{atan2}(y, x)`, elevation :math:`\mathrm{atan2}(z,
    \sqrt{x^2 + y^2})` and range, of :math:`p - p_s = (x, y, z)`.

    Args:
        r: noise: a variance for all, variances (rad^2, rad^2, m^2), (3, 3), or a function of
            `params`.
        position: p_s: (3,), or a function of (params, t), or of `params`; None: the origin.
        dims: number of space dimensions, 3.

    Deviations: straight above the sensor the azimuth, and at the sensor itself all three, are
        undefined: 0 with a zero gradient.
    """
    checks.require(dims == 3, "dims", "3, since an elevation needs space", dims)
    return _looking(r, position, None, 3, (_bearing, _elevation, _range))


def _at_least_two(dims: int) -> int:
    return checks.whole("dims", dims, 2)


def _looking(
    r: Parameter, position: Place, velocity: Place, dims: int | None, parts: tuple[Part, ...]
) -> Sensor:
    """The sensor of these parts."""
    if dims is None:
        dims = 2 if position is None or callable(position) else int(np.size(position))
    count = checks.whole("dims", dims, 1)
    position = np.zeros(count) if position is None else position
    place = place_of("position", position, count)
    speed = motion_of(position, velocity, count) if _range_rate in parts else None

    def observe(params: Params, x: Array, t: Array) -> Array:
        needed = count if speed is None else 2 * count
        checks.require(
            x.shape[0] >= needed, "sensors", f"a state of at least {needed} components", x.shape[0]
        )
        away = x[:count] - place(params, t, x.dtype)
        leaving = None
        if speed is not None:
            leaving = x[count : 2 * count] - speed(params, t, x.dtype)
        return jnp.stack([part(away, leaving) for part in parts])

    angle = tuple(part in (_bearing, _elevation) for part in parts)
    return Sensor(observe, noise_cov("r", r, len(parts)), angle)


def _length(vector: Array) -> tuple[Array, Array]:
    """The length, and whether it is 0 (also for what the dtype cannot square)."""
    square = jnp.sum(jnp.square(vector))
    zero = square == 0
    return jnp.where(zero, 0, jnp.sqrt(jnp.where(zero, 1, square))), zero


def _range(away: Array, leaving: Array | None) -> Array:
    del leaving
    return _length(away)[0]


def _range_rate(away: Array, leaving: Array | None) -> Array:
    assert leaving is not None
    length, here = _length(away)
    return jnp.where(here, 0, jnp.sum(away * leaving) / jnp.where(here, 1, length))


def _bearing(away: Array, leaving: Array | None) -> Array:
    del leaving
    return _direction(away[1], away[0])


def _elevation(away: Array, leaving: Array | None) -> Array:
    del leaving
    return _direction(away[2], _length(away[:2])[0])


def _direction(y: Array, x: Array) -> Array:
    """atan2(y, x), 0 with a zero gradient where that is undefined."""
    # By squares, which the derivative divides by.
    here = jnp.square(x) + jnp.square(y) == 0
    return jnp.arctan2(jnp.where(here, 0, y), jnp.where(here, 1, x))
