"""Models given in continuous time, discretised exactly over any interval."""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.core import Tracer

from ewif_jax import checks
from ewif_jax.fast.small import matmul, matvec
from ewif_jax.models import domain
from ewif_jax.models.bank import Bank, bank
from ewif_jax.models.discrete import pattern_of_powers
from ewif_jax.models.inputs import driven, need_both
from ewif_jax.models.model import Linear, Model, affine_motion, linear_model
from ewif_jax.models.parameters import named
from ewif_jax.models.powers import Stride, both_strides
from ewif_jax.models.sensors import Seen, Sensor
from ewif_jax.recipe import from_recipe
from ewif_jax.types import DTypeLike, Numbers, Parameter, Params

TERMS = 19
"""Of each series: what is left out is below 1 / 20! where the norm of A dt is at most 1/2."""
HALVINGS = 40
"""How often an interval is halved, at most: enough for a norm of A dt of 5e11."""


@from_recipe
def from_continuous(
    A: Parameter,
    G: Parameter,
    intensity: Parameter,
    sensors: Sensor | Sequence[Sensor] | None = None,
    *,
    H: Parameter = None,
    R: Parameter = None,
    b: Parameter = None,
    B: Parameter = None,
    u: Parameter = None,
) -> Model:
    r"""The linear model of :math:`dx = (A x + b)\,dt + G\,dw` over any interval, also backwards.

    .. math::
        F = e^{A\,dt}, \quad Q = \int_0^{dt} e^{A s} G\,q\,G' e^{A' s}\,ds, \quad
        c = \int_0^{dt} e^{A s} b\,ds

    with q = `intensity`, the covariance of w per second: Van Loan (1978). The three integrals are
    the series of the matrix exponential over a short part of the interval, which is then doubled:
    with F, Q, c of half of it they are :math:`F F,\; F Q F' + Q,\; F c + c`. So Q is a sum of
    positive semidefinite terms, and nothing grows as the backward exponential of Van Loan's block
    matrix does.

    Args:
        A: (n, n) in 1/s, or a function of `params`.
        G: (n, k), how the noise drives the state, or a function of `params`.
        intensity: of the noise, (k, k), (k,) or a number, or a function of `params`.
        sensors: one or several linear `Sensor`; a measurement's `sensor` chooses. Or:
        H, R: as in `linear_model`.
        b: a constant input per second (n,), or a function of `params`; or None.
        B, u: how an input drives the state, dx = (A x + b + B u) dt: (n, k) or a function of
            `params`, and `inputs(times, values)` or a function of `params` that gives them,
            integrated exactly; or None.

    Differentiable in A, G, intensity, b, and in the times.

    Reduces to: `random_walk`, `constant_velocity` and `constant_acceleration` with white noise for
        their A and G.

    Raises:
        ValueError: shapes that do not fit, an intensity that is not a covariance, neither or both
            of `sensors` and `H`, `R`; a sensor that is not linear.
    """
    checks.require(
        (sensors is None) != (H is None and R is None),
        "sensors",
        "either sensors or both H and R",
        "both" if sensors is not None else "neither",
    )
    need_both(B, u)
    named_here = (("A", A), ("G", G), ("intensity", intensity), ("b", b), ("B", B))
    A, G, intensity, b, B = (_given_matrix(argument, x) for argument, x in named_here)
    F_where = None
    if isinstance(A, np.ndarray):
        checks.shape("A", A, (len(A), len(A)))
        F_where = pattern_of_powers(A)
        if isinstance(G, np.ndarray):
            checks.shape("G", G, (len(A), "k"))
        if isinstance(b, np.ndarray):
            checks.shape("b", b, (len(A),))
        if isinstance(B, np.ndarray):
            checks.shape("B", B, (len(A), "k"))
    if isinstance(intensity, np.ndarray):
        checks.psd("intensity", _squared_up(intensity, np))

    def drift_over(params: Params, t0: Numbers, t1: Numbers) -> tuple[Array, Array]:
        """A (n, n) in the direction of time, and the length of the interval."""
        drift, dt = _matrix_value(A, params), domain.floating(t1) - domain.floating(t0)
        checks.shape("A", drift, (drift.shape[0],) * 2)
        dtype = jnp.promote_types(drift.dtype, dt.dtype)
        drift, dt = drift.astype(dtype), dt.astype(dtype)
        return jnp.where(dt < 0, -drift, drift), jnp.where(dt < 0, -dt, dt)

    def noise_of(params: Params, dtype: DTypeLike) -> Array:
        drive = _matrix_value(G, params).astype(dtype)
        checks.shape("G", drive, ("n", "k"))
        k = drive.shape[1]
        q = _squared_up(_matrix_value(intensity, params), jnp).astype(dtype)
        q = q if isinstance(intensity, np.ndarray) else domain.covariance("intensity", q)
        q = q * jnp.eye(k, dtype=dtype) if q.shape == (1, 1) else q
        checks.shape("intensity", q, (k, k))
        return matmul(matmul(drive, q), drive.T)

    def F(params: Params, t0: Array, t1: Array) -> Array:
        return integrated(*drift_over(params, t0, t1))[0]

    def process_cov(params: Params, t0: Array, t1: Array) -> Array:
        drift, dt = drift_over(params, t0, t1)
        return integrated(drift, dt, noise=noise_of(params, drift.dtype))[1]

    def gathered(params: Params, t0: Array, t1: Array) -> Array:
        drift, dt = drift_over(params, t0, t1)
        push = _matrix_value(b, params).astype(drift.dtype)
        checks.shape("b", push, drift.shape[:1])
        return integrated(drift, dt, push=jnp.where(t1 < t0, -push, push))[2]

    def response(params: Params, t0: Array, t1: Array) -> Array:
        drift, dt = drift_over(params, t0, t1)
        pushes = _matrix_value(B, params).astype(drift.dtype)
        checks.shape("B", pushes, (drift.shape[0], "k"))
        return jax.vmap(lambda push: integrated(drift, dt, push=push)[2], 1, 1)(pushes)

    offset = None if b is None else gathered
    if u is not None:
        offset = driven(F, response, u, offset)
    if sensors is None:
        seen = linear_model(F, H, R, b=offset)
    else:
        group = bank(sensors)
        seen = Model(
            affine_motion(F, offset),
            process_cov,
            group.observe,
            group.cov,
            group.residual,
            _seen_linearly(A, group, F, offset),
            group.count,
            check=domain.check_covariances(None, group.cov),
            sizes=group.sizes,
            latency=group.latency,
        )
    check_seen = seen.check

    def check(params: Params, t0: Numbers, t1: Numbers, sensors: Numbers) -> None:
        if callable(intensity) and t1 > t0:
            checks.psd("intensity", _squared_up(np.asarray(intensity(params)), np))
        if check_seen is not None:
            check_seen(params, t0, t1, sensors)

    if seen.linear is not None:
        seen = seen._replace(linear=seen.linear._replace(F_where=F_where))
    return seen._replace(process_cov=process_cov, check=check)


def _seen_linearly(A: Parameter, group: Bank, F: Seen, b: Seen | None) -> Linear | None:
    """The matrices of the model, if all sensors are linear."""
    matrix = group.matrix
    if matrix is None:
        return None
    if not callable(A):
        H, H_where = matrix(len(A))
        return Linear(F, b, H, None, H_where, offset=group.offset)

    def H_of(params: Params, sensor: Array, t: Array) -> Array:
        size = jax.eval_shape(lambda: _matrix_value(A, params)).shape[0]  # known when it is asked
        return matrix(size)[0](params, sensor, t)

    return Linear(F, b, H_of, offset=group.offset)


def integrated(
    A: Array, dt: Array, noise: Array | None = None, push: Array | None = None
) -> tuple[Array, Any, Any]:
    """exp(A dt), and the integrals over s from 0 to dt >= 0 of exp(A s) noise exp(A s)' and of
    exp(A s) push, where these are given."""
    # Halved until the series is short, then doubled: with norm 1 twice, and exp(1) = exp(1/2)^2.
    length = lax.stop_gradient(jnp.max(jnp.sum(abs(A), 0)) * dt)
    halvings = jnp.ceil(jnp.log2(jnp.maximum(2 * length, 1)))
    enough = halvings <= HALVINGS
    halvings = jnp.where(enough, halvings, 0)
    h = dt * jnp.exp2(-halvings)
    eye = jnp.eye(A.shape[0], dtype=A.dtype)
    starts = Stride(eye, None if push is None else push * h, None if noise is None else noise * h)

    # Each series holds what begins like this and has this (linear) derivative.
    def following(carry: tuple[Stride, Stride], k: Array) -> tuple[tuple[Stride, Stride], None]:
        term, total = carry
        term = Stride(
            matmul(A, term.F) * (h / k),
            None if term.b is None else matvec(A, term.b) * (h / (k + 1)),
            None if term.Q is None else _both_sides(A, term.Q) * (h / (k + 1)),
        )
        return (term, jax.tree.map(jnp.add, total, term)), None

    numbers = jnp.arange(1, TERMS, dtype=A.dtype)
    first = lax.scan(following, (starts, starts), numbers)[0][1]

    def doubled(stride: Stride, number: Array) -> tuple[Stride, None]:
        twice = lax.cond(number < halvings, _doubled_stride, lambda x: x, stride)
        return twice, None

    def all_doubled(stride: Stride) -> Stride:
        # A fixed number of rounds, most of which pass through: a `while` loop has no reverse
        # derivative.
        return lax.scan(doubled, stride, jnp.arange(HALVINGS))[0]

    # Short intervals, the usual ones, skip the rounds altogether.
    found = lax.cond(halvings > 0, all_doubled, lambda x: x, first)
    found = jax.tree.map(lambda x: jnp.where(enough, x, jnp.nan), found)
    return found.F, found.Q, found.b


def _both_sides(A: Array, x: Array) -> Array:
    half = matmul(A, x)
    return half + half.T


def _doubled_stride(stride: Stride) -> Stride:
    return both_strides(stride, stride, matmul, matvec)


def _given_matrix(argument: str, value: Numbers) -> Any:
    """An array of NumPy, or a function of `params`, or None; what is not finite is refused."""
    if value is None:
        return None
    if callable(value):
        return named(value)
    if isinstance(value, Tracer):
        return lambda params: value
    checks.finite(argument, value)
    return np.array(value, float)


def _matrix_value(value: Numbers, params: Params) -> Array:
    """What it is for these parameters."""
    return domain.floating(value(params) if callable(value) else value)


def _squared_up(q: Parameter, xp: Any) -> Any:
    """An intensity as a matrix: of a number (1, 1), of variances (k, k)."""
    q = xp.atleast_1d(xp.asarray(q))
    return xp.diag(q) if q.ndim == 1 else q
