"""The arrowhead path of Yoder et al., sections 4.2 and 4.3, tracked by models that are wrong."""

import jax
import jax.numpy as jnp
from jax import Array, lax

from ewif_jax import checks, models
from ewif_jax.models import Model, position_sensor, wrap_angle
from ewif_jax.monte_carlo import Scenario, Simulation
from ewif_jax.recipe import from_recipe
from ewif_jax.scenarios.delays import deliver, exponential_delays, regular_times
from ewif_jax.types import Gaussian, Numbers, Parameter, Params

RADIUS, SPEED = 100.0, 5.0
EKF_Q = (0.0383, 0.0383, 0.1768, 0.0139)
EKF_R = (2000.0, 2000.0, 4.0, 0.04)


def arrowhead_path(time: Numbers) -> Array:
    r"""Position (..., 2) in m at `time` (...) in seconds.

    .. math::
        x = \rho \sin(\omega t + \sin \omega t), \quad
        y = \rho \cos(\omega t + \cos \omega t - \cos 1) \quad (14)

    with rho = 100 m, omega = 0.05 rad/s: nominally 5 m/s, once around in 126 s.
    """
    angle = SPEED / RADIUS * jnp.asarray(time)
    east = jnp.sin(angle + jnp.sin(angle))
    north = jnp.cos(angle + jnp.cos(angle) - jnp.cos(1.0))
    return RADIUS * jnp.stack([east, north], -1)


def arrowhead_state(time: Numbers) -> Array:
    """x, y (m), speed (m/s) and heading (rad) along the path, (..., 4)."""
    time = jnp.asarray(time)
    position, velocity = jax.jvp(arrowhead_path, (time,), (jnp.ones_like(time),))
    speed = jnp.linalg.norm(velocity, axis=-1, keepdims=True)
    heading = jnp.arctan2(velocity[..., 1:], velocity[..., :1])
    return jnp.concatenate([position, speed, heading], -1)


@from_recipe
def arrowhead_model(q: Parameter = 20.0, r: Parameter = 2000.0) -> Model:
    """The random walk (no velocity) that follows the path in section 4.2; q in m^2/s and r in m^2,
    numbers or functions of `params`."""
    return models.random_walk(sensors=position_sensor(r, dims=2), q=q, dims=2)


@from_recipe
def arrowhead(
    r: float = 2000.0, dt: float = 1.0, mean_delay: float = 5.0, steps: int = 10_000
) -> Scenario:
    """The path's position, measured every `dt` s with variance `r` m^2 on each axis and delayed by
    exponential times of mean `mean_delay` s.

    Truth is the position at the newest validity time that has arrived. The start is known.
    """
    checks.positive("r", r)
    return _delayed_stream(arrowhead_path, (r, r), dt, mean_delay, steps)


@from_recipe
def arrowhead_ekf_model(q: Parameter = EKF_Q, r: Parameter = EKF_R) -> Model:
    r"""Position, speed and heading with all four measured: the model of section 4.3.

    .. math::
        x \mathrel{+}= v \Delta t \cos\theta, \quad y \mathrel{+}= v \Delta t \sin\theta, \quad
        z = x + \nu \quad (15)\text{-}(16)

    The paper leaves Q and R open. `q` (4,) are variances per second, by default those of the
    path's one-step residuals; `r` (4,) those of the measurements. The heading's innovation is
    wrapped to (-pi, pi].
    """
    Q, R = jnp.diag(jnp.asarray(q)), jnp.diag(jnp.asarray(r))
    checks.shape("q", Q, (4, 4))
    checks.shape("r", R, (4, 4))
    checks.psd("q", Q)
    checks.psd("r", R, definite=True)

    def transition(params: Params, x: Array, t0: Array, t1: Array) -> Array:
        del params
        way = x[2] * (t1 - t0)
        still = jnp.zeros_like(way)
        return x + jnp.stack([way * jnp.cos(x[3]), way * jnp.sin(x[3]), still, still])

    def residual(value: Array, predicted: Array, sensor: Array) -> Array:
        del sensor
        difference = value - predicted
        return jnp.concatenate([difference[:3], wrap_angle(difference[3:])])

    return Model(
        transition,
        process_cov=lambda params, t0, t1: (t1 - t0) * Q,
        observe=lambda params, x, sensor, t: x,
        measurement_cov=lambda params, sensor, t: R,
        residual=residual,
        sensors=1,
    )


@from_recipe
def arrowhead_ekf(
    r: tuple[float, float, float, float] = EKF_R,
    dt: float = 1.0,
    mean_delay: float = 5.0,
    steps: int = 10_000,
) -> Scenario:
    """The path's position, speed and heading, measured and delayed as in `arrowhead`, with the
    variances `r` of `arrowhead_ekf_model`. Truth is the position."""
    checks.shape("r", r, (4,))
    checks.positive("r", r)
    return _delayed_stream(arrowhead_state, r, dt, mean_delay, steps)


def _delayed_stream(
    path: Numbers, r: Parameter, dt: float, mean_delay: float, steps: int
) -> Scenario:
    start = path(jnp.asarray(0.0))
    size = start.shape[0]

    def simulate(key: Array) -> Simulation:
        noise, wait = jax.random.split(key)
        time = regular_times(dt, steps, start=dt)
        seen = path(time)
        value = seen + jnp.sqrt(jnp.asarray(r))[None] * jax.random.normal(noise, (steps, size))
        arrived = deliver(time, value, exponential_delays(wait, mean_delay, steps))
        newest = lax.cummax(arrived.order)
        return Simulation(arrived.measurements, seen[newest, :2])

    return Scenario(simulate, Gaussian(start, jnp.zeros((size, size))), 0.0)
