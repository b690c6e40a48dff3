"""Sensors that are registered wrongly, and stamps that are not quite right."""

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ewif_jax import checks
from ewif_jax.models.linearise import need_model
from ewif_jax.models.model import Model
from ewif_jax.models.parameters import resolve
from ewif_jax.models.sensors import Sensor
from ewif_jax.recipe import from_recipe
from ewif_jax.types import Parameter, Params


@from_recipe
def biased(sensor: Sensor, bias: Parameter) -> Sensor:
    r"""The sensor with a registration error, :math:`z = h(x, t) + b + v`.

    Args:
        sensor: any `Sensor`; if it is linear, so is this one.
        bias: b: (m,) in the units of its components (a number if there is one), or a function of
            `params`, to be tuned with the rest.

    What data cannot tell apart: a bias of the position and another starting position of everything,
    where no second sensor is without bias; a bias along the track of a target that keeps its
    velocity v, and a latency of b / v seconds; a bias of a bearing and a sensor that stands
    elsewhere, as long as the target is seen in one direction. Tune one of the two, or take a target
    that turns.

    Raises:
        ValueError: a bias that is not (m,), or not finite.

    Reduces to: `sensor` with a bias of zero.
    """
    is_sensor = isinstance(sensor, Sensor)
    checks.require(is_sensor, "sensor", "a Sensor", f"a {type(sensor).__name__}")
    m = len(sensor.angle)
    if not callable(bias):
        checks.shape("bias", bias, () if m == 1 and np.ndim(bias) == 0 else (m,))
        checks.finite("bias", bias)

    def bias_of(params: Params) -> Array:
        found = jnp.asarray(resolve(bias, params))
        found = found[None] if m == 1 and found.ndim == 0 else found
        checks.shape("bias", found, (m,))
        return found

    def observe(params: Params, x: Array, t: Array) -> Array:
        return sensor.observe(params, x, t) + bias_of(params).astype(x.dtype)

    def offset(params: Params, t: Array) -> Array:
        own = bias_of(params)
        return own if sensor.offset is None else sensor.offset(params, t) + own

    linear = sensor.matrix is not None
    return sensor._replace(observe=observe, offset=offset if linear else None)


@from_recipe
def jittered(model: Model, sigma_t: Parameter) -> Model:
    r"""The model for stamps that are uncertain, each by its own error of known size.

    A value that was true at :math:`t + \delta` and is stamped t differs by
    :math:`\dot z\,\delta` from the value at t. To first order that is noise of covariance

    .. math::
        R + \sigma_t^2\,\dot z\,\dot z', \quad
        \dot z = \frac{d}{ds} h(f(x, t, s), s) \Big|_{s = t} = H \dot x + \partial h / \partial t,

    with f the motion of the state x that the filter predicts at t. A lateness that is the same for
    all is no jitter: `latency=` takes that out.

    Args:
        model: linear or not, in continuous time.
        sigma_t: standard deviation of the stamps in seconds: a number >= 0, (S,) of each sensor, or
            a function of `params` that gives one of these.

    The noise depends on the estimate, so every run of a batch has its own gain. Filters that start
    from nothing (`prior=None`) take the stamps as exact until the measurements determine a state.

    Raises:
        ValueError: a model in discrete time, whose state has no rate; a negative sigma_t; methods
            that need R before there is an estimate (`batch_wls`, `two_sided_ewif`, `run_parallel`,
            `limited_memory`).

    Reduces to: `model` with sigma_t = 0, or where nothing moves.
    """
    need_model(model, "jittered")
    checks.require(
        model.steps is None,
        "model",
        "a model in continuous time, whose state has a rate (functions of (params, t0, t1), a "
        "kinematic model, models.from_continuous)",
        "a model in discrete time",
    )
    if not callable(sigma_t):
        _check_sigma(model, sigma_t)
    before = model.jitter

    def jitter(params: Params, x: Array, sensor: Array, t: Array) -> Array:
        sigma = resolve(sigma_t, params)
        _check_sigma(model, sigma)
        sigma = jnp.asarray(sigma, x.dtype)
        sigma = sigma[sensor] if sigma.ndim else sigma

        def seen(s: Array) -> Array:
            there = jnp.asarray(model.transition(params, x, t, s), x.dtype)
            return jnp.asarray(model.observe(params, there, sensor, s), x.dtype)

        t = jnp.asarray(t, x.dtype)
        rate = jax.jvp(seen, (t,), (jnp.ones_like(t),))[1]
        extra = jnp.square(sigma) * rate[:, None] * rate[None, :]
        return extra if before is None else extra + before(params, x, sensor, t)

    return model._replace(jitter=jitter)


def _check_sigma(model: Model, sigma_t: Parameter) -> None:
    count = "S" if model.sensors is None else model.sensors
    checks.shape("sigma_t", sigma_t, (count,) if np.ndim(sigma_t) else ())
    checks.at_least("sigma_t", sigma_t, 0.0)
    checks.finite("sigma_t", sigma_t)
