"""What sensors see. Every kinematic state begins with the position, so a sensor fits any."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from ewif_jax import checks
from ewif_jax.models import domain
from ewif_jax.models.parameters import resolve, with_time
from ewif_jax.models.places import Place, place_of
from ewif_jax.recipe import FromRecipe, from_recipe
from ewif_jax.types import Parameter, Params

Seen = Callable[..., Array]


class _SensorFields(NamedTuple):
    observe: Seen
    cov: Seen
    angle: tuple[bool, ...]
    matrix: Callable[[int], np.ndarray] | None = None
    offset: Seen | None = None
    latency: Parameter = 0.0


class Sensor(FromRecipe, _SensorFields):
    """One sensor: observe(params, x, t) -> (m,), cov(params, t) -> (m, m), which of its m
    components are angles, and, if it is linear, matrix(n) -> (m, n) and offset(params, t) -> (m,)
    (None: zero) of z = H x + offset; latency, seconds by which its stamps are late, a number or a
    function of `params`."""


@from_recipe
def sensor(
    observe: Seen,
    cov: Parameter,
    size: int = 1,
    angle: bool | Sequence[bool] | None = None,
    latency: Parameter = 0.0,
) -> Sensor:
    r"""A sensor of your own, :math:`z = h(x, t) + v`.

    Args:
        observe: h, function (params, x, t) -> (size,) in the dtype of x, differentiable.
        cov: of v: a variance, (size,) variances, (size, size), or a function of `params`, or of
            (params, t), that gives one of these.
        size: how many numbers it says.
        angle: which of them are angles in radians, (size,) booleans, or one for all; None: none.
            Their differences are wrapped into (-pi, pi].
        latency: seconds by which its stamps are late, a number or a function of `params`; every
            entry takes them out of the times, see `corrected`.

    Raises:
        ValueError: a cov that is no covariance of `size` numbers, an angle of another length, a
            latency that is not a finite number; when
            it is used, an `observe` that gives another shape.
    """
    checks.require(callable(observe), "observe", "a function (params, x, t)", repr(observe))
    m = checks.whole("size", size, 1)
    flags = np.broadcast_to(angle, m) if isinstance(angle, bool | np.bool_) else angle
    flags = np.zeros(m, bool) if flags is None else np.asarray(flags)
    checks.require(flags.dtype == bool, "angle", f"{m} booleans", angle)
    checks.shape("angle", flags, (m,))
    if not callable(latency):
        checks.shape("latency", latency, ())
        checks.finite("latency", latency)

    def seen(params: Params, x: Array, t: Array) -> Array:
        value = observe(params, x, t)
        checks.shape("observe", value, (m,))
        return value

    return Sensor(seen, noise_cov("cov", cov, m), tuple(map(bool, flags)), latency=latency)


@from_recipe
def position_sensor(r: Parameter, dims: int = 1, position: Place = None) -> Sensor:
    """A sensor of the first `dims` state components (the position).

    Args:
        r: noise variance in m^2, a number, (dims,) variances, a matrix (dims, dims), or a function
            of `params`.
        dims: number of space dimensions.
        position: of the sensor, from where it counts: (dims,), or a function (params, t) -> (dims,)
            or of `params`; None: the origin.
    """
    return _part_of_state(r, checks.whole("dims", dims, 1), 0, "position", position)


@from_recipe
def velocity_sensor(r: Parameter, dims: int = 1, velocity: Place = None) -> Sensor:
    """A sensor of the `dims` state components after the position (the velocity).

    Args:
        r: noise variance in (m/s)^2, a number, (dims,) variances, a matrix (dims, dims), or a
            function of `params`.
        dims: number of space dimensions.
        velocity: of the sensor, to which it compares: (dims,), or a function (params, t) -> (dims,)
            or of `params`; None: it stands still.

    Raises:
        ValueError: a state without a velocity.
    """
    m = checks.whole("dims", dims, 1)
    return _part_of_state(r, m, m, "velocity", velocity)


def _part_of_state(r: Parameter, m: int, first: int, argument: str, own: Place) -> Sensor:
    """A sensor of m components of the state from `first` on, less its own."""
    origin = None if own is None else place_of(argument, own, m)

    def observe(params: Params, x: Array, t: Array) -> Array:
        _need_components(first + m, x.shape[0])
        seen = x[first : first + m]
        return seen if origin is None else seen - origin(params, t, x.dtype)

    def matrix(n: int) -> np.ndarray:
        _need_components(first + m, n)
        return np.eye(m, n, k=first)

    def offset(params: Params, t: Array) -> Array:
        assert origin is not None
        return -origin(params, t, jnp.result_type(t, 0.0))

    return Sensor(
        observe,
        noise_cov("r", r, m),
        (False,) * m,
        matrix,
        None if origin is None else offset,
    )


def _need_components(needed: int, n: int) -> None:
    checks.require(
        n >= needed, "sensors", f"a state of at least {needed} components for this sensor", n
    )


def wrap_angle(angle: Array) -> Array:
    """The same direction in (-pi, pi]; NaN where the dtype does not resolve turns any more."""
    # An angle within (-pi, pi] stays what it is to the last bit, however small.
    wrapped = angle - 2 * jnp.pi * jnp.ceil((angle - jnp.pi) / (2 * jnp.pi))
    return jnp.where(jnp.abs(wrapped) <= 4, wrapped, jnp.nan)


def noise_cov(argument: str, r: Parameter, m: int) -> Seen:
    """cov(params, t) -> (m, m) of a variance, (m,) variances, (m, m), or a function of `params` or
    (params, t) that gives one of these."""
    if not callable(r):
        if np.ndim(r) == 2:
            checks.psd(argument, r)
            checks.shape(argument, r, (m, m))
        else:
            domain.check_variance(argument, r, (m,) if np.ndim(r) else ())
    timed = with_time(r)

    def cov(params: Params, t: Array) -> Array:
        value: Any = r(params, t) if timed else resolve(r, params)
        if np.ndim(value) == 2:
            checks.shape(argument, value, (m, m))
            return domain.covariance(argument, value)
        shape = (m,) if np.ndim(value) else ()
        value = domain.floating(domain.variance(argument, value, params, shape))
        # NumPy's eye: JAX's is a program, compiled where something known is asked inside a trace.
        return (value[:, None] if shape else value) * np.eye(m, dtype=value.dtype)

    return cov
