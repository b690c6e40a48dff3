"""The model of the world that every filter shares, linear or not."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ewif_jax import checks
from ewif_jax.fast.compiling import array
from ewif_jax.fast.small import matvec
from ewif_jax.fast.sparse import Pattern, pattern
from ewif_jax.models.sensor_range import check_sensor


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
    F, n = _one_step(F)
    if not callable(Q) and Q is not None:
        checks.psd("Q", Q)
        checks.shape("Q", Q, ("n" if n is None else n,) * 2)
        Q = _over_one_interval(jnp.asarray(Q))
    if b is not None:
        b = _input(b, n)
    H, rows = _by_sensor("H", H)
    R, cols = _by_sensor("R", R)
    sensors = _count_sensors(rows, cols)

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
    linear = Linear(F, b, H, _pattern_of_powers(given[0]), _pattern_of_table(given[1]))
    return Model(transition, process_cov, observe, measurement_cov, subtract, linear, sensors)


def affine_motion(F: Any, b: Any) -> Callable[..., Array]:
    """The transition (params, x, t0, t1) -> (n,) of x(t1) = F x(t0) + b, in either direction."""

    def transition(params: Any, x: Array, t0: Array, t1: Array) -> Array:
        matrix, offset = _affine(F, b, params, t0, t1, x.dtype)
        moved = matvec(matrix, x)
        return moved if offset is None else moved + offset

    return transition


def affine_flow(
    model: Model, params: Any, t0: Array, t1: Array, dtype: Any
) -> tuple[Array, Array | None]:
    """F (n, n) and c (n,) or None of a linear model: x(t1) = F x(t0) + c, in either direction.

    Against time c is derived from the forward input: c(t1, t0) = -F(t1, t0) b(t0, t1).
    """
    linear = need_linear(model, "this operation")
    return _affine(linear.F, linear.b, params, t0, t1, dtype)


def flow(model: Model, params: Any, x: Array, t0: Array, t1: Array) -> tuple[Array, Array, Array]:
    """x at t1 (n,), the Jacobian F (n, n) of the motion at x, and Q (n, n) for t1 >= t0."""
    Q = jnp.asarray(model.process_cov(params, t0, t1), x.dtype)
    if model.linear is not None:
        F, c = affine_flow(model, params, t0, t1, x.dtype)
        checks.shape("F", F, (x.shape[0],) * 2)
        moved = matvec(F, x, model.linear.F_where)
        return (moved if c is None else moved + c), F, Q

    def move(x: Array) -> Array:
        return jnp.asarray(model.transition(params, x, t0, t1), x.dtype)

    F = jax.jacfwd(move)(x)
    checks.shape("F", F, (x.shape[0],) * 2)
    return move(x), F, Q


def sight(
    model: Model, params: Any, x: Array, sensor: Array, t: Array
) -> tuple[Array, Array, Array]:
    """Predicted measurement (m,), its Jacobian H (m, n) at x, and R (m, m)."""
    check_sensor(model, params, x, sensor, t)
    R = jnp.asarray(model.measurement_cov(params, sensor, t), x.dtype)
    if model.linear is not None:
        H = jnp.asarray(model.linear.H(params, sensor, t), x.dtype)
        checks.shape("H", H, ("m", x.shape[0]))
        checks.shape("R", R, (H.shape[0],) * 2)
        return matvec(H, x, model.linear.H_where), H, R

    def see(x: Array) -> Array:
        return jnp.asarray(model.observe(params, x, sensor, t), x.dtype)

    H = jax.jacfwd(see)(x)
    checks.shape("R", R, (H.shape[0],) * 2)
    return see(x), H, R


def patterns(model: Model) -> tuple[Pattern | None, Pattern | None]:
    """Where F and H of a model may differ from zero, if that is known."""
    return (None, None) if model.linear is None else (model.linear.F_where, model.linear.H_where)


def observation(
    model: Model, params: Any, sensor: Array, t: Array, dtype: Any
) -> tuple[Array, Array]:
    """H (m, n) and R (m, m) of a linear model."""
    linear = need_linear(model, "this operation")
    check_sensor(model, params, None, sensor, t)
    H = jnp.asarray(linear.H(params, sensor, t), dtype)
    return H, jnp.asarray(model.measurement_cov(params, sensor, t), dtype)


def size(model: Model, params: Any, t0: Any) -> int:
    """n, read off a linear model without computing anything."""
    linear = need_linear(model, "prior=None")
    return jax.eval_shape(lambda: jnp.asarray(linear.F(params, t0, t0))).shape[0]


def need_model(model: Model, method: str) -> None:
    """Refuses what is not a model, for the method that wants one."""
    ok = isinstance(model, Model)
    expected = f"a Model (linear_model(...), models.*) for {method}"
    checks.require(ok, "model", expected, f"a {type(model).__name__}")


def need_linear(model: Model, method: str) -> Linear:
    """The matrices of `model`, or an error that says which method wanted them."""
    need_model(model, method)
    checks.require(
        model.linear is not None,
        "model",
        f"a linear model: {method} needs F and H (use `extended` for a nonlinear one)",
        "a Model without matrices",
    )
    assert model.linear is not None
    return model.linear


def _affine(
    F: Any, b: Any, params: Any, t0: Array, t1: Array, dtype: Any
) -> tuple[Array, Array | None]:
    matrix = jnp.asarray(F(params, t0, t1), dtype)
    if b is None:
        return matrix, None
    ahead = jnp.asarray(b(params, jnp.minimum(t0, t1), jnp.maximum(t0, t1)), dtype)
    return matrix, jnp.where(t1 >= t0, ahead, -matvec(matrix, ahead))


def _input(b: Any, n: int | None) -> Any:
    if callable(b):
        return b
    checks.shape("b", b, ("n" if n is None else n,))
    return _over_one_interval(jnp.asarray(b))


def _one_step(F: Any) -> tuple[Any, int | None]:
    """F as a function of (params, t0, t1), and its size if it is constant."""
    if callable(F):
        return F, None
    checks.shape("F", F, ("n", "n"))
    checks.require(np.shape(F)[0] == np.shape(F)[1], "F", "a square matrix", np.shape(F))
    checks.finite("F", F)
    ahead = array(F)
    n = ahead.shape[0]
    known = np.asarray(F)
    invertible = np.linalg.matrix_rank(known) == n
    back = jnp.asarray(np.linalg.inv(known) if invertible else np.full((n, n), np.nan), ahead.dtype)

    def matrix(params: Any, t0: Array, t1: Array) -> Array:
        del params
        still = jnp.eye(n, dtype=ahead.dtype)
        return jnp.where(t1 > t0, ahead, jnp.where(t1 < t0, back, still))

    return matrix, n


def _pattern_of_powers(F: Any) -> Pattern | None:
    """Where any power of a constant F, and so its inverse, may differ from zero."""
    if callable(F):
        return None
    n = np.shape(F)[0]
    return pattern(np.linalg.matrix_power((np.asarray(F) != 0) + np.eye(n), n))


def _pattern_of_table(H: Any) -> Pattern | None:
    """Where a constant matrix, or any of a table, may differ from zero."""
    known = None if callable(H) else checks.known(H)
    return None if known is None else pattern(*known.reshape(-1, *known.shape[-2:]))


def _over_one_interval(value: Array) -> Any:
    return lambda params, t0, t1: jnp.where(t0 == t1, 0, value)


def _by_sensor(argument: str, x: Any) -> tuple[Any, int | None]:
    """A function of (params, sensor, t), and how many sensors it knows of: S of a table, 0 for a
    matrix that all sensors share, None for a function."""
    if callable(x):
        return x, None
    table = array(x)
    checks.finite(argument, x)
    checks.require(
        table.ndim in (2, 3), argument, "a function, a matrix or a table (S, ., .)", table.shape
    )
    if argument == "R":
        for k, matrix in enumerate(np.asarray(x) if table.ndim == 3 else [x]):
            checks.psd("R" if table.ndim == 2 else f"R[{k}]", matrix)
    if table.ndim == 2:
        return (lambda params, sensor, t: table), 0
    return (lambda params, sensor, t: select(table, sensor)), table.shape[0]


def _count_sensors(rows: int | None, cols: int | None) -> int | None:
    """How many sensors H and R speak of together; one matrix each is one sensor."""
    tables = [count for count in (rows, cols) if count]
    checks.require(
        len(set(tables)) < 2, "R", f"as many sensors as H has ({rows})", f"{cols} sensors"
    )
    return tables[0] if tables else 1 if rows == cols == 0 else None


def select(table: Array, index: Array) -> Array:
    """table[index] for a small table, as a product (a gather is slow in a batch)."""
    # Products are of floats, and of the floats there are now, if x64 was switched since.
    whole = not jnp.issubdtype(table.dtype, jnp.inexact)
    table = table.astype(jnp.result_type(float if whole else table.dtype))
    chosen = (jnp.arange(table.shape[0]) == index).astype(table.dtype)
    return matvec(table.reshape(table.shape[0], -1).T, chosen).reshape(table.shape[1:])
