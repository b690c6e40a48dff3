"""The model of the world that every filter shares, linear or not."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from ewif_jax import checks
from ewif_jax.fast.small import matvec
from ewif_jax.fast.sparse import Pattern
from ewif_jax.models.discrete import constant_input, one_step, over_one_interval, pattern_of_powers
from ewif_jax.models.tables import by_sensor, count_sensors, pattern_of_table


def resolve(value: Any, params: Any) -> Any:
    """`value(params)` if it is a function of the parameters, else `value`."""
    return value(params) if callable(value) else value


def subtract(value: Array, predicted: Array, sensor: Array) -> Array:
    """The plain residual: measured minus predicted."""
    del sensor
    return value - predicted


class Linear(NamedTuple):
    """The matrices of a linear model: x(t1) = F x(t0) + b, z = H x.

    F(params, t0, t1) -> (n, n); b(params, t0, t1) -> (n,) or None; H(params, sensor, t) -> (m, n).
    F_where and H_where: where F (in either direction) and H may differ from zero, if that is known;
    what is zero is not computed.
    """

    F: Callable[..., Array]
    b: Callable[..., Array] | None
    H: Callable[..., Array]
    F_where: Pattern | None = None
    H_where: Pattern | None = None


class Model(NamedTuple):
    """How a state moves and what the sensors see; pure functions, intervals always explicit.

    transition(params, x, t0, t1) -> (n,); t1 < t0 asks for the reversed motion
    process_cov(params, t0, t1) -> (n, n), for t1 >= t0
    observe(params, x, sensor, t) -> (m,)
    measurement_cov(params, sensor, t) -> (m, m)
    residual(value, predicted, sensor) -> (m,); wraps angles
    linear: the matrices if the model is linear
    sensors: how many there are, if known
    """

    transition: Callable[..., Array]
    process_cov: Callable[..., Array]
    observe: Callable[..., Array]
    measurement_cov: Callable[..., Array]
    residual: Callable[..., Array] = subtract
    linear: Linear | None = None
    sensors: int | None = None


def linear_model(F: Any, H: Any, R: Any, Q: Any = None, b: Any = None) -> Model:
    r"""A linear model :math:`x(t_1) = F x(t_0) + b + w,\; z = H x + v`.

    Args:
        F: function (params, t0, t1) -> (n, n), also for t1 < t0 where late data or smoothing need
            it; or a constant (n, n), the transition over one interval *whatever its length*.
        H: function (params, sensor, t) -> (m, n); or a constant (m, n); or a table (S, m, n).
        R: covariance of v, likewise: function, (m, m) or (S, m, m).
        Q: covariance of w, function (params, t0, t1) -> (n, n) for t1 >= t0, or a constant (n, n)
            for one interval, or None (no process noise).
        b: known input, function (params, t0, t1) -> (n,) for t1 >= t0, or a constant (n,) for one
            interval, or None.

    Constants F, Q and b speak of one step of equally spaced data: over an empty interval F is the
    identity and Q and b are zero; against time F is inverted. For stamps of any other kind give
    functions of (t0, t1), or use `ewif_jax.models`.

    Raises:
        ValueError: a constant has the wrong shape, or a constant Q or R is not PSD; tables H and R
            speak of different numbers of sensors.
    """
    given = F, H
    F, n = one_step(F)
    if not callable(Q) and Q is not None:
        checks.psd("Q", Q)
        checks.shape("Q", Q, ("n" if n is None else n,) * 2)
        Q = over_one_interval(jnp.asarray(Q))
    if b is not None:
        b = constant_input(b, n)
    H, rows = by_sensor("H", H)
    R, cols = by_sensor("R", R)
    sensors = count_sensors(rows, cols)

    def process_cov(params: Any, t0: Array, t1: Array) -> Array:
        if Q is None:
            size = jax.eval_shape(lambda: jnp.asarray(F(params, t0, t1))).shape[0]
            return jnp.zeros((size, size))
        return jnp.asarray(Q(params, t0, t1))

    def observe(params: Any, x: Array, sensor: Array, t: Array) -> Array:
        return matvec(jnp.asarray(H(params, sensor, t), x.dtype), x)

    def measurement_cov(params: Any, sensor: Array, t: Array) -> Array:
        return jnp.asarray(R(params, sensor, t))

    transition = affine_motion(F, b)
    linear = Linear(F, b, H, pattern_of_powers(given[0]), pattern_of_table(given[1]))
    return Model(transition, process_cov, observe, measurement_cov, subtract, linear, sensors)


def affine_motion(F: Any, b: Any) -> Callable[..., Array]:
    """The transition (params, x, t0, t1) -> (n,) of x(t1) = F x(t0) + b, in either direction."""

    def transition(params: Any, x: Array, t0: Array, t1: Array) -> Array:
        matrix, offset = affine(F, b, params, t0, t1, x.dtype)
        moved = matvec(matrix, x)
        return moved if offset is None else moved + offset

    return transition


def affine(
    F: Any, b: Any, params: Any, t0: Array, t1: Array, dtype: Any
) -> tuple[Array, Array | None]:
    """F (n, n) and c (n,) or None of x(t1) = F x(t0) + c, in either direction."""
    matrix = jnp.asarray(F(params, t0, t1), dtype)
    if b is None:
        return matrix, None
    ahead = jnp.asarray(b(params, jnp.minimum(t0, t1), jnp.maximum(t0, t1)), dtype)
    return matrix, jnp.where(t1 >= t0, ahead, -matvec(matrix, ahead))
