"""Polynomial motion in any number of dimensions, exactly discretised over any interval.

The state lists the position first, then the velocity, then the acceleration: [x, y, vx, vy, ...].
"""

from collections.abc import Callable, Sequence
from math import factorial
from typing import Any, Literal

import jax.numpy as jnp
import numpy as np
from jax import Array

from ewif_jax import checks
from ewif_jax.kernels.small import matvec
from ewif_jax.kernels.sparse import pattern
from ewif_jax.models.model import Linear, Model, affine_motion, resolve
from ewif_jax.models.sensors import Sensor, bank


def random_walk(
    *, sensors: Sensor | Sequence[Sensor], q: Any = 0.0, dims: int = 1, b: Any = None
) -> Model:
    r"""Position driven by white noise: :math:`Q = q\,\Delta t`, q in m^2/s."""
    return _kinematic(0, sensors, q, dims, "white", b)


def constant_velocity(
    *,
    sensors: Sensor | Sequence[Sensor],
    q: Any = 0.0,
    dims: int = 1,
    noise: Literal["white", "discrete"] = "white",
    b: Any = None,
) -> Model:
    r"""Nearly constant velocity.

    Args:
        sensors: one or several `Sensor`; a measurement's `sensor` chooses.
        q: process noise, a number or a function of `params`. "white": power spectral density of
            white acceleration, m^2/s^3, :math:`Q = q [[dt^3/3, dt^2/2], [dt^2/2, dt]]`.
            "discrete": variance of an acceleration held constant over each interval, m^2/s^4,
            :math:`Q = q\,\Gamma\Gamma', \Gamma = (dt^2/2, dt)` (DWNA). It does not compose over
            parts of an interval: do not use it where late data split one.
        dims: number of space dimensions.
        noise: which of the two.
        b: known input, function (params, t0, t1) -> (n,) for t1 >= t0.
    """
    return _kinematic(1, sensors, q, dims, noise, b)


def constant_acceleration(
    *,
    sensors: Sensor | Sequence[Sensor],
    q: Any = 0.0,
    dims: int = 1,
    noise: Literal["white", "discrete"] = "white",
    b: Any = None,
) -> Model:
    """Nearly constant acceleration; arguments as in `constant_velocity`, one derivative higher
    (q is the density of white jerk in m^2/s^5, or the variance of a constant jerk)."""
    return _kinematic(2, sensors, q, dims, noise, b)


def _kinematic(
    order: int,
    sensors: Sensor | Sequence[Sensor],
    q: Any,
    dims: int,
    noise: str,
    b: Callable[..., Array] | None,
) -> Model:
    checks.whole("dims", dims, 1)
    checks.require(noise in ("white", "discrete"), "noise", "'white' or 'discrete'", repr(noise))
    if not callable(q):
        checks.shape("q", q, ())
        checks.at_least("q", q, 0.0)
    n = (order + 1) * dims
    observe, cov, residual, matrix, count = bank(sensors)
    F_terms = np.kron(_motion(order), np.eye(dims))
    noise_terms = _white(order) if noise == "white" else _piecewise_constant(order)
    Q_terms = np.kron(noise_terms, np.eye(dims))

    def F(params: Any, t0: Array, t1: Array) -> Array:
        del params
        return _polynomial(F_terms, t1 - t0)

    def process_cov(params: Any, t0: Array, t1: Array) -> Array:
        return resolve(q, params) * _polynomial(Q_terms, t1 - t0)

    linear = None
    if matrix is not None:
        H, H_where = matrix(n)
        linear = Linear(F, b, H, pattern(*F_terms), H_where)
    transition = affine_motion(F, b)
    return Model(transition, process_cov, observe, cov, residual, linear, count)


def _polynomial(terms: np.ndarray, dt: Array) -> Array:
    """sum_k terms[k] dt^k for constant matrices terms (K, n, n): one product."""
    dt = jnp.asarray(dt)
    powers = [jnp.ones_like(dt)]
    for _ in range(len(terms) - 1):
        powers.append(powers[-1] * dt)
    flat = jnp.asarray(terms.reshape(len(terms), -1).T, dt.dtype)
    return matvec(flat, jnp.stack(powers)).reshape(terms.shape[1:])


def _motion(order: int) -> np.ndarray:
    terms = np.zeros((order + 1, order + 1, order + 1))
    for i in range(order + 1):
        for j in range(i, order + 1):
            terms[j - i, i, j] = 1 / factorial(j - i)
    return terms


def _white(order: int) -> np.ndarray:
    """Q of white noise on the highest derivative: integral of the propagated noise."""
    terms = np.zeros((2 * order + 2, order + 1, order + 1))
    for i in range(order + 1):
        for j in range(order + 1):
            a, c = order - i, order - j
            terms[a + c + 1, i, j] = 1 / (factorial(a) * factorial(c) * (a + c + 1))
    return terms


def _piecewise_constant(order: int) -> np.ndarray:
    """Q of the next derivative held constant over the interval (DWNA for order 1)."""
    terms = np.zeros((2 * (order + 1) + 1, order + 1, order + 1))
    for i in range(order + 1):
        for j in range(order + 1):
            a, c = order + 1 - i, order + 1 - j
            terms[a + c, i, j] = 1 / (factorial(a) * factorial(c))
    return terms
