"""Polynomial motion in any number of dimensions, exactly discretised over any interval.

The state lists the position first, then the velocity, then the acceleration: [x, y, vx, vy, ...].
"""

from collections.abc import Callable, Sequence
from functools import cache
from math import factorial
from typing import Literal

import jax.numpy as jnp
import numpy as np
from jax import Array

from ewif_jax import checks
from ewif_jax.fast.batched import kernel
from ewif_jax.fast.sparse import Pattern, pattern
from ewif_jax.models import domain
from ewif_jax.models.bank import bank
from ewif_jax.models.inputs import driven
from ewif_jax.models.model import Linear, Model, affine_motion
from ewif_jax.models.parameters import resolve
from ewif_jax.models.sensors import Sensor
from ewif_jax.recipe import from_recipe
from ewif_jax.types import Numbers, Parameter, Params

Function = Callable[[Array], Array]


@from_recipe
def random_walk(
    *,
    sensors: Sensor | Sequence[Sensor],
    q: Parameter = 0.0,
    dims: int = 1,
    b: Parameter = None,
    u: Parameter = None,
) -> Model:
    r"""Position driven by white noise: :math:`Q = q\,\Delta t`, q in m^2/s. A known input u is a
    velocity; see `constant_velocity`."""
    return _kinematic_model(0, sensors, q, dims, "white", b, u)


@from_recipe
def constant_velocity(
    *,
    sensors: Sensor | Sequence[Sensor],
    q: Parameter = 0.0,
    dims: int = 1,
    noise: Literal["white", "discrete"] = "white",
    b: Parameter = None,
    u: Parameter = None,
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
        u: known acceleration, `inputs(times, values)` with values (K, dims) in m/s^2, or a function
            of `params` that gives them; integrated exactly.
    """
    return _kinematic_model(1, sensors, q, dims, noise, b, u)


@from_recipe
def constant_acceleration(
    *,
    sensors: Sensor | Sequence[Sensor],
    q: Parameter = 0.0,
    dims: int = 1,
    noise: Literal["white", "discrete"] = "white",
    b: Parameter = None,
    u: Parameter = None,
) -> Model:
    """Nearly constant acceleration; arguments as in `constant_velocity`, one derivative higher
    (q is the density of white jerk in m^2/s^5, or the variance of a constant jerk; u is a known
    jerk)."""
    return _kinematic_model(2, sensors, q, dims, noise, b, u)


def _kinematic_model(
    order: int,
    sensors: Sensor | Sequence[Sensor],
    q: Parameter,
    dims: int,
    noise: str,
    b: Callable[..., Array] | None,
    u: Parameter,
) -> Model:
    checks.whole("dims", dims, 1)
    checks.require(noise in ("white", "discrete"), "noise", "'white' or 'discrete'", repr(noise))
    if not callable(q):
        domain.check_variance("q", q)
    n = (order + 1) * dims
    group = bank(sensors)
    check_seen = domain.check_covariances(None, group.cov)
    motion, spread, F_where = _motion_matrices(order, dims, noise)

    def F(params: Params, t0: Array, t1: Array) -> Array:
        del params
        return motion(_interval_of(t0, t1))

    def process_cov(params: Params, t0: Array, t1: Array) -> Array:
        return domain.scaled(domain.variance("q", q, params), spread(_interval_of(t0, t1)))

    def check(params: Params, t0: Numbers, t1: Numbers, sensors: Numbers) -> None:
        if t1 > t0:
            domain.check_variance("q", resolve(q, params))
        check_seen(params, t0, t1, sensors)

    if u is not None:
        response = _response_matrix(order, dims)
        b = driven(F, lambda params, t0, t1: response(_interval_of(t0, t1)), u, b)
    linear = None
    if group.matrix is not None:
        H, H_where = group.matrix(n)
        linear = Linear(F, b, H, F_where, H_where, offset=group.offset)
    transition = affine_motion(F, b)
    return Model(
        transition,
        process_cov,
        group.observe,
        group.cov,
        group.residual,
        linear,
        group.count,
        check=check,
        returns_well=True,
        sizes=group.sizes,
        latency=group.latency,
    )


def _interval_of(t0: Numbers, t1: Numbers) -> Array:
    dt = jnp.asarray(t1) - t0
    return dt.astype(jnp.result_type(dt, 0.0))


@cache
def _motion_matrices(order: int, dims: int, noise: str) -> tuple[Function, Function, Pattern]:
    """dt () -> F and Q / q (n, n), and where F may differ from zero."""
    coefficient, power = _motion_terms(order)
    motion = _monomial_matrix(coefficient, power, dims)
    noise_terms = _white_terms(order) if noise == "white" else _held_terms(order)
    return motion, _monomial_matrix(*noise_terms, dims), pattern(np.kron(coefficient, np.eye(dims)))


@cache
def _response_matrix(order: int, dims: int) -> Function:
    """dt () -> what the next derivative, held at 1 over dt, does to the state (n, dims)."""
    power = order + 1 - np.arange(order + 1)[:, None]
    return _monomial_matrix(1 / _factorial_of(power), power, dims)


def _monomial_matrix(coefficient: np.ndarray, power: np.ndarray, dims: int) -> Function:
    """dt () -> coefficient dt^power, element by element, the same in every dimension."""
    coefficient = np.kron(coefficient, np.eye(dims))
    # JAX keeps what it made of an index array, so it must not be made anew when x64 is switched.
    power = np.kron(power, np.ones((dims, dims), int)).astype(np.int32)

    def matrix(dt: Array) -> Array:
        powers = [jnp.ones_like(dt)]
        for _ in range(power.max()):
            powers.append(powers[-1] * dt)
        across = (..., *(None,) * dt.ndim)
        return jnp.stack(powers)[power] * jnp.asarray(coefficient, dt.dtype)[across]

    return kernel(matrix, cheap=True)


def _motion_terms(order: int) -> tuple[np.ndarray, np.ndarray]:
    """Coefficients and powers (order + 1, order + 1) of F: dt^(j - i) / (j - i)!."""
    i, j = np.indices((order + 1, order + 1))
    power = np.maximum(j - i, 0)
    return np.where(j >= i, 1 / _factorial_of(power), 0), power


def _white_terms(order: int) -> tuple[np.ndarray, np.ndarray]:
    """Q of white noise on the highest derivative: integral of the propagated noise."""
    a, c = order - np.indices((order + 1, order + 1))
    return 1 / (_factorial_of(a) * _factorial_of(c) * (a + c + 1)), a + c + 1


def _held_terms(order: int) -> tuple[np.ndarray, np.ndarray]:
    """Q of the next derivative held constant over the interval (DWNA for order 1)."""
    a, c = order + 1 - np.indices((order + 1, order + 1))
    return 1 / (_factorial_of(a) * _factorial_of(c)), a + c


def _factorial_of(x: np.ndarray) -> np.ndarray:
    return np.vectorize(factorial)(x)
