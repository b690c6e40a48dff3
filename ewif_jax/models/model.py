"""The model of the world that every filter shares, linear or not."""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ewif_jax import checks
from ewif_jax.fast.compiling import one_program
from ewif_jax.fast.small import matvec
from ewif_jax.fast.sparse import Pattern
from ewif_jax.models import domain
from ewif_jax.models.discrete import constant, is_discrete, motion, pattern_of_powers
from ewif_jax.models.inputs import driven, need_both
from ewif_jax.models.parameters import named, resolve
from ewif_jax.models.steps import check_steps
from ewif_jax.models.tables import (
    by_sensor,
    count_sensors,
    of_sizes,
    pattern_of_table,
    same_sizes,
    wider,
    wider_cov,
)
from ewif_jax.recipe import FromRecipe, from_recipe
from ewif_jax.types import DTypeLike, Numbers, Parameter, Params, Steps

__all__ = ["Linear", "Model", "affine", "affine_motion", "linear_model", "resolve", "subtract"]


def subtract(value: Array, predicted: Array, sensor: Array) -> Array:
    """The plain residual: measured minus predicted."""
    del sensor
    return value - predicted


class Linear(NamedTuple):
    """The matrices of a linear model: x(t1) = F x(t0) + b, z = H x.

    F(params, t0, t1) -> (n, n); b(params, t0, t1) -> (n,) or None; H(params, sensor, t) -> (m, n).
    F_where and H_where: where F (in either direction) and H may differ from zero, if that is known;
    what is zero is not computed. reversible: False where F is known to have no inverse.
    offset: offset(params, sensor, t) -> (m,) where z = H x + offset, or None.
    """

    F: Callable[..., Array]
    b: Callable[..., Array] | None
    H: Callable[..., Array]
    F_where: Pattern | None = None
    H_where: Pattern | None = None
    reversible: bool = True
    offset: Callable[..., Array] | None = None


class _ModelFields(NamedTuple):
    transition: Callable[..., Array]
    process_cov: Callable[..., Array]
    observe: Callable[..., Array]
    measurement_cov: Callable[..., Array]
    residual: Callable[..., Array] = subtract
    linear: Linear | None = None
    sensors: int | None = None
    steps: Steps | None = None
    check: Callable[..., None] | None = None
    returns_well: bool = False
    sizes: tuple[int, ...] | None = None
    jitter: Callable[..., Array] | None = None
    latency: Parameter = None
    state_angle: tuple[bool, ...] | None = None


class Model(FromRecipe, _ModelFields):
    """How a state moves and what the sensors see; pure functions, intervals always explicit.

    transition(params, x, t0, t1) -> (n,); t1 < t0 asks for the reversed motion
    process_cov(params, t0, t1) -> (n, n), for t1 >= t0
    observe(params, x, sensor, t) -> (m,)
    measurement_cov(params, sensor, t) -> (m, m)
    residual(value, predicted, sensor) -> (m,); wraps angles
    linear: the matrices if the model is linear
    sensors: how many there are, if known
    steps: how time is counted if the model is discrete (what is between two steps is NaN)
    check: check(params, t0, t1, sensors) refuses known parameters that make no covariances, Q only
        if t1 > t0; None: process_cov and measurement_cov are looked at
    returns_well: whether motion back in time loses no digits: over long intervals it grows as a
        polynomial (kinematic motion), not exponentially
    sizes: how many components each sensor has, where they differ: values are as wide as the widest,
        and what a sensor lacks is absent (see `models.components`)
    jitter: jitter(params, x, sensor, t) -> (m, m), noise beside measurement_cov that depends on the
        predicted state (see `models.jittered`)
    latency: (S,) seconds by which the stamps of each sensor are late, or a function of params that
        gives them; or None
    state_angle: (n,) which components of the state are angles in radians (None: none). Sigma
        points, ensembles, particles and smoothers then compare and average them on the circle, and
        `transition` may wrap them
    """


@from_recipe
def linear_model(
    F: Parameter,
    H: Parameter,
    R: Parameter,
    Q: Parameter = None,
    b: Parameter = None,
    *,
    B: Parameter = None,
    u: Parameter = None,
    dt: float = 1.0,
    max_steps: int = 1023,
) -> Model:
    r"""A linear model :math:`x(t_1) = F x(t_0) + b + w,\; z = H x + v`.

    An F that is an array, or a function of `params` alone, makes a model in discrete time: it
    speaks of one step of `dt` seconds. Over k steps

    .. math::
        F_k = F^k, \quad b_k = \sum_{i<k} F^i b, \quad Q_k = \sum_{i<k} F^i Q F^{i\prime},

    over none nothing happens, and against time F is inverted. Rows may be missing, late, or far
    apart, as long as every time is whole steps away from t0 (to 0.01 dt, or what the times' dtype
    can tell apart). A time between two steps is refused where it is known; else what arrives then
    is `REJECTED` and the filter stays where it is. An identity F given as an array, with neither
    Q nor b of one step, stands still over any interval.

    Args:
        F: function (params, t0, t1) -> (n, n), also for t1 < t0 where late data or smoothing need
            it; or for one step: (n, n), or a function of `params` alone.
        H: function (params, sensor, t) -> (m, n); (m, n); a table (S, m, n); a list of matrices
            with as many rows as each sensor has components; or a function of `params` alone that
            gives one of the first three.
        R: covariance of v, likewise: function, (m, m), (S, m, m), list of matrices, or function of
            `params` alone.
        Q: covariance of w, function (params, t0, t1) -> (n, n) for t1 >= t0; for one step (n, n) or
            a function of `params` alone; or None (no process noise).
        b: known input, function (params, t0, t1) -> (n,) for t1 >= t0; for one step (n,) or a
            function of `params` alone; or None.
        B: what a constant unit input does to the state, function (params, t0, t1) -> (n, k) for
            t1 >= t0; for one step (n, k) or a function of `params` alone; or None.
        u: the input, `inputs(times, values)` or a function of `params` that gives them; integrated
            exactly, cut at its own times. A discrete model takes inputs that change at whole steps:
            a change between two steps is refused where it is known, else what it drives is NaN.
        dt: seconds of one step, a number > 0.
        max_steps: how many steps may be asked for at once.

    A function of (params, t0, t1) speaks of its whole interval, beside a discrete F too. The
    derivatives of a discrete model with respect to times are 0. In a batch whose times differ by
    run every interval costs what the longest might: shared times are faster.

    Raises:
        ValueError: a constant has the wrong shape, or a constant Q or R is not PSD; tables H and R
            speak of different numbers of sensors, or of components; Q or b of one step beside an F
            that is a function of (params, t0, t1).
    """
    checks.require(
        checks.concrete_value(dt) is not None, "dt", "a number, not a parameter", "a tracer"
    )
    checks.positive("dt", dt)
    steps = Steps(float(dt), checks.whole("max_steps", max_steps, 1))
    F = constant("F", F, ("n", "n")) if is_discrete(F) else named(F)
    n: int | str = "n"
    if isinstance(F, np.ndarray):
        checks.require(F.shape[0] == F.shape[1], "F", "a square matrix", F.shape)
        n = F.shape[0]
    if not callable(Q) and Q is not None:
        checks.psd("Q", Q)
    Q = constant("Q", Q, (n, n)) if is_discrete(Q) else Q and named(one_program(Q))
    b = constant("b", b, (n,)) if is_discrete(b) else named(b)
    need_both(B, u)
    B = constant("B", B, (n, "k")) if is_discrete(B) else named(B)
    H, sizes_of_H = of_sizes("H", H, wider)
    R, sizes_of_R = of_sizes("R", R, wider_cov)
    sizes = same_sizes(sizes_of_H, sizes_of_R)
    H_given, R_varies = H, callable(R)
    H, rows = by_sensor("H", H)
    R, cols = by_sensor("R", R)
    sensors = count_sensors(rows, cols)
    moved = motion(F, Q, b, B, steps)
    offset = moved.b if moved.B is None else driven(moved.F, moved.B, u, moved.b)

    def process_cov(params: Params, t0: Array, t1: Array) -> Array:
        if moved.Q is None:
            size = jax.eval_shape(lambda: jnp.asarray(moved.F(params, t0, t1))).shape[0]
            return jnp.zeros((size, size))
        found = jnp.asarray(moved.Q(params, t0, t1))
        return domain.covariance("Q", found) if callable(Q) else found

    def observe(params: Params, x: Array, sensor: Array, t: Array) -> Array:
        return matvec(jnp.asarray(H(params, sensor, t), x.dtype), x)

    def measurement_cov(params: Params, sensor: Array, t: Array) -> Array:
        found = jnp.asarray(R(params, sensor, t))
        return domain.covariance("R", found) if R_varies else found

    linear = Linear(
        moved.F, offset, H, pattern_of_powers(F), pattern_of_table(H_given), moved.reversible
    )
    check = domain.check_covariances(
        process_cov if callable(Q) else None, measurement_cov if R_varies else None
    )
    if u is not None and is_discrete(B):
        check = partial(_check_input, u, steps, check)
    return Model(
        affine_motion(moved.F, offset),
        process_cov,
        observe,
        measurement_cov,
        linear=linear,
        sensors=sensors,
        steps=moved.steps,
        check=check,
        sizes=sizes,
    )


def _check_input(
    u: Parameter,
    steps: Steps,
    check: Callable[..., None],
    params: Params,
    t0: Numbers,
    t1: Numbers,
    sensors: Numbers,
) -> None:
    """`check`, after refusing known inputs of a discrete model that change between two steps."""
    times = resolve(u, params).times
    check_steps(steps, times, t0, jnp.result_type(float), "u.times", in_order=False)
    check(params, t0, t1, sensors)


def affine_motion(F: Parameter, b: Parameter) -> Callable[..., Array]:
    """The transition (params, x, t0, t1) -> (n,) of x(t1) = F x(t0) + b, in either direction."""

    def transition(params: Params, x: Array, t0: Array, t1: Array) -> Array:
        matrix, offset = affine(F, b, params, t0, t1, x.dtype)
        moved = matvec(matrix, x)
        return moved if offset is None else moved + offset

    return transition


def affine(
    F: Parameter, b: Parameter, params: Params, t0: Array, t1: Array, dtype: DTypeLike
) -> tuple[Array, Array | None]:
    """F (n, n) and c (n,) or None of x(t1) = F x(t0) + c, in either direction."""
    matrix = jnp.asarray(F(params, t0, t1), dtype)
    if b is None:
        return matrix, None
    forwards = t1 >= t0
    # Not the minimum and the maximum, which share the derivative between equal times: that in t1 at
    # t0 is the rate of the state (`models.jittered`).
    start, end = jnp.where(forwards, t0, t1), jnp.where(forwards, t1, t0)
    ahead = jnp.asarray(b(params, start, end), dtype)
    return matrix, jnp.where(forwards, ahead, -matvec(matrix, ahead))
