"""Data saturation: a filter that trusts a model which is slightly wrong (Anderson 1973, section 4).

The filter believes that a scalar stands still, dx = 0, z = x + v with unit noise density and
x(0) ~ N(0, 1). In truth x is pushed, by white noise or steadily. Three remedies are compared.
"""

from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from ewif_jax import checks
from ewif_jax.estimators.fading import fading
from ewif_jax.estimators.kalman import kalman
from ewif_jax.estimators.limited_memory import limited_memory
from ewif_jax.models import position_sensor, random_walk
from ewif_jax.models.model import resolve
from ewif_jax.monte_carlo import Scenario, Simulation
from ewif_jax.recipe import from_recipe
from ewif_jax.types import Estimator, Gaussian, Measurement, Numbers, Params

Remedy = Literal["none", "noise", "weighting", "memory"]
Push = Literal["white", "constant"]
REMEDIES: tuple[Remedy, ...] = ("none", "noise", "weighting", "memory")
PUSHES: tuple[Push, ...] = ("white", "constant")


class Growth(NamedTuple):
    """g = exp(integral of the gain), its integral, those of g^2 and of (dg/dt)^2, and 1: all (T,),
    divided by a power of e^(rate t) (the square where g is squared) so that nothing overflows."""

    g: Array
    of_g: Array
    of_square: Array
    of_slope: Array
    one: Array


def divergence_curve(
    remedy: Remedy, push: Push, time: Numbers, *, eps: Numbers, setting: Numbers = None
) -> Array:
    r"""The exact mean square error E|x - x_hat|^2 (T,) of the continuous filter.

    With the gain K and :math:`g = e^{\int K}`, :math:`\mathcal E = (1 + \int \dot g^2 + \epsilon
    \int g^2) / g^2` under white noise of density eps, and :math:`(1 + \int \dot g^2) / g^2 +
    (\epsilon \int g / g)^2` under a steady push eps: (4-9) for (4-12), in closed form.

    Args:
        remedy: "none": K = 1 / (t + 1). "noise": the filter is told of an input noise of density
            `setting` (white). "weighting": exponential weighting with alpha = `setting` in 1/s.
            "memory": only the last `setting` seconds count (the prior while t is below).
        push: "white" or "constant".
        time: (T,) seconds >= 0.
        eps: density of the white noise, or rate of the steady push in 1/s.
        setting: of the remedy, > 0.

    Deviations: for the steady push the paper prints :math:`1/(t+1) + \epsilon (t+1)/2`; it is
        :math:`1/(t+1) + (\epsilon^2/4) (t + 1 - 1/(t+1))^2`.

    Raises:
        ValueError: an unknown remedy or push; a setting missing or <= 0.
    """
    _check_setting(remedy, push, setting)
    time = jnp.asarray(time)
    time = time if jnp.issubdtype(time.dtype, jnp.floating) else time.astype(float)
    if remedy == "memory":
        early = _divergence_error(_remedy_growth("none", time, None), push, eps)
        late = 1 / setting + (eps * setting / 3 if push == "white" else (eps * setting / 2) ** 2)
        return jnp.where(time <= setting, early, late)
    return _divergence_error(_remedy_growth(remedy, time, setting), push, eps)


@from_recipe
def divergence_filter(remedy: Remedy, *, dt: float, setting: Numbers = None) -> Estimator:
    """The filter with a remedy, for the samples of `divergence`.

    Args:
        remedy, setting: as in `divergence_curve`; `setting` may be a function of `params`, except
            for "memory" (it sizes a buffer).
        dt: sampling interval in seconds.
    """
    _check_setting(remedy, "white", setting)
    checks.positive("dt", dt)
    sensors = position_sensor(1.0 / dt)
    if remedy == "noise":
        return kalman(random_walk(sensors=sensors, q=setting))
    still = random_walk(sensors=sensors)
    if remedy == "none":
        return kalman(still)
    if remedy == "memory":
        samples = checks.whole("setting / dt", round(setting / dt), 1)
        return limited_memory(still, (samples - 0.5) * dt, samples + 1)

    def inflation(params: Params, t0: Array, t1: Array) -> Array:
        return jnp.exp(2 * resolve(setting, params) * (t1 - t0))

    return fading(still, inflation=inflation)


@from_recipe
def divergence(push: Push, *, eps: float, dt: float = 0.02, length: float = 20.0) -> Scenario:
    """The pushed scalar, sampled every `dt` s for `length` s with noise variance 1 / dt, so that
    the filters tend to the continuous ones as dt goes to 0; the prior is N(0, 1) at t = 0.

    Args:
        push, eps: as in `divergence_curve`.
    """
    _check_setting("none", push, None)
    checks.positive("dt", dt)
    checks.positive("length", length)
    steps = round(length / dt)

    def simulate(key: Array) -> Simulation:
        start, steered, noise = jax.random.split(key, 3)
        time = jnp.arange(1, steps + 1) * dt
        if push == "white":
            moved = jnp.cumsum(jnp.sqrt(eps * dt) * jax.random.normal(steered, (steps,)))
        else:
            moved = eps * time
        x = (jax.random.normal(start) + moved)[:, None]
        z = x + jax.random.normal(noise, (steps, 1)) / jnp.sqrt(dt)
        sensor = jnp.zeros(steps, jnp.int32)
        return Simulation(Measurement(time, z, sensor, jnp.ones((steps, 1), bool)), x)

    return Scenario(simulate, Gaussian(jnp.zeros(1), jnp.eye(1)), 0.0)


def _divergence_error(growth: Growth, push: Push, eps: Numbers) -> Array:
    g, of_g, of_square, of_slope, one = growth
    own = one + of_slope
    if push == "white":
        return (own + eps * of_square) / g**2
    return own / g**2 + (eps * of_g / g) ** 2


def _remedy_growth(remedy: Remedy, t: Array, setting: Numbers) -> Growth:
    if remedy == "none":
        g = 1 + t
        return Growth(g, t + t**2 / 2, t + t**2 + t**3 / 3, t, jnp.ones_like(t))
    if remedy == "weighting":
        rate = 2 * setting
        rest = rate - 1
        d = jnp.exp(-rate * t)
        grown = -jnp.expm1(-rate * t) / rate
        grown_twice = -jnp.expm1(-2 * rate * t) / (2 * rate)
        return Growth(
            (1 + rest * d) / rate,
            (grown + rest * t * d) / rate,
            (grown_twice + 2 * rest * grown * d + rest**2 * t * d**2) / rate**2,
            grown_twice,
            d**2,
        )
    s = jnp.sqrt(setting)
    d2 = jnp.exp(-2 * s * t)
    cosh, sinh = (1 + d2) / 2, -jnp.expm1(-2 * s * t) / 2
    double = -jnp.expm1(-4 * s * t) / (8 * s)
    of_cosh2, of_sinh2, of_both = double + t * d2 / 2, double - t * d2 / 2, sinh**2 / (2 * s)
    d = jnp.exp(-s * t)
    return Growth(
        cosh + sinh / s,
        sinh / s + (cosh - d) / s**2,
        of_cosh2 + 2 * of_both / s + of_sinh2 / s**2,
        setting * of_sinh2 + 2 * s * of_both + of_cosh2,
        d2,
    )


def _check_setting(remedy: str, push: str, setting: Numbers) -> None:
    checks.require(remedy in REMEDIES, "remedy", f"one of {REMEDIES}", repr(remedy))
    checks.require(push in PUSHES, "push", f"one of {PUSHES}", repr(push))
    if remedy != "none":
        checks.require(setting is not None, "setting", f"a number > 0 for {remedy!r}", None)
        if not callable(setting):
            checks.positive("setting", setting)
