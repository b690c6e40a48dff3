"""A target that turns at a rate nobody knows."""

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jax import Array

from ewif_jax import checks
from ewif_jax.models import domain
from ewif_jax.models.bank import bank
from ewif_jax.models.model import Model
from ewif_jax.models.parameters import resolve
from ewif_jax.models.sensors import Sensor
from ewif_jax.recipe import from_recipe
from ewif_jax.types import Numbers, Parameter, Params

STRAIGHT = np.zeros((3, 5, 5))
STRAIGHT[:, :4, :4] = [
    np.kron(power, np.eye(2))
    for power in ([[0, 0], [0, 1]], [[0, 1 / 2], [1 / 2, 0]], [[1 / 3, 0], [0, 0]])
]
"""Q of white acceleration: what stands at dt, dt^2 and dt^3"""
TURNING = np.diag([0.0, 0.0, 0.0, 0.0, 1.0])


@from_recipe
def coordinated_turn(
    *, sensors: Sensor | Sequence[Sensor], q: Parameter = 0.0, q_turn: Parameter = 0.0
) -> Model:
    r"""Motion in the plane at a constant, unknown turn rate, with Cartesian velocity.

    The state is :math:`[x, y, v_x, v_y, \omega]`. Over dt the velocity turns by
    :math:`\omega\,dt`, and the target moves along the chord of its arc, which turns half as far:

    .. math::
        p(t_1) = p(t_0) + dt\,\frac{\sin a}{a}\,R(a)\,v(t_0), \quad
        v(t_1) = R(2a)\,v(t_0), \quad a = \omega\,dt / 2,

    with R(a) the rotation by a. The noise is that of white acceleration on each axis and of a
    white turn acceleration,

    .. math::
        Q = \begin{pmatrix} q\,dt^3/3 & q\,dt^2/2 & \\ q\,dt^2/2 & q\,dt & \\ & & q_\omega\,dt
        \end{pmatrix}, \quad dt = |t_1 - t_0|.

    This is what Orguner & Gustafsson, section IV, leave open: q = 10^2, q_omega = 0.1^2 there.

    Args:
        sensors: one or several `Sensor`; a measurement's `sensor` chooses.
        q: density of the white acceleration in m^2/s^3, a number or a function of `params`.
        q_turn: density of the white turn acceleration in rad^2/s^3, likewise.

    Motion runs backwards as well, and exactly: there and back again is the same state. The noise
    knows nothing of the turn: over parts of an interval it composes as that of constant velocity
    does, exactly where the rate and q_turn are 0, and up to what turns within the interval
    elsewhere.

    Reduces to: `constant_velocity` in two dimensions where the turn rate is 0.

    Raises:
        ValueError: a negative q or q_turn; a state that has not five components.
    """
    for argument, density in (("q", q), ("q_turn", q_turn)):
        if not callable(density):
            domain.check_variance(argument, density)
    group = bank(sensors)
    check_seen = domain.check_covariances(None, group.cov)

    def transition(params: Params, x: Array, t0: Array, t1: Array) -> Array:
        del params
        checks.shape("state", x, (5,))
        dt = t1 - t0
        half = x[4] * dt / 2
        s, c = jnp.sin(half), jnp.cos(half)
        chord = dt * _sine_ratio(half)
        east, north = c * x[2] - s * x[3], s * x[2] + c * x[3]
        return jnp.stack(
            [
                x[0] + chord * east,
                x[1] + chord * north,
                c * east - s * north,
                s * east + c * north,
                x[4],
            ]
        )

    def process_cov(params: Params, t0: Array, t1: Array) -> Array:
        dt = jnp.abs(jnp.asarray(t1 - t0))
        straight, turning = jnp.asarray(STRAIGHT, dt.dtype), jnp.asarray(TURNING, dt.dtype)
        moving = straight[0] * dt + straight[1] * dt**2 + straight[2] * dt**3
        driven = domain.scaled(domain.variance("q", q, params), moving)
        turned = domain.scaled(domain.variance("q_turn", q_turn, params), dt * turning)
        return driven + turned.astype(driven.dtype)

    def check(params: Params, t0: Numbers, t1: Numbers, sensors: Numbers) -> None:
        if t1 > t0:
            for argument, density in (("q", q), ("q_turn", q_turn)):
                domain.check_variance(argument, resolve(density, params))
        check_seen(params, t0, t1, sensors)

    return Model(
        transition,
        process_cov,
        group.observe,
        group.cov,
        group.residual,
        sensors=group.count,
        check=check,
        sizes=group.sizes,
        latency=group.latency,
    )


def _sine_ratio(a: Array) -> Array:
    """sin(a) / a: near 0 its series, so that derivatives lose no digits there."""
    near = jnp.abs(a) < 0.5
    square = jnp.square(jnp.where(near, a, 0))
    series = jnp.ones_like(a)
    for k in range(12, 0, -2):
        series = 1 - series * square / (k * (k + 1))
    away = jnp.where(near, 1, a)
    return jnp.where(near, series, jnp.sin(away) / away)
