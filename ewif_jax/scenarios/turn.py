"""A fast clockwise turn seen by two bearing sensors and a late third: Orguner & Gustafsson,
section IV."""

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ewif_jax import checks, models
from ewif_jax.models import Model, Sensor, bearing_sensor
from ewif_jax.monte_carlo import Scenario, Simulation
from ewif_jax.recipe import from_recipe
from ewif_jax.types import Gaussian, Measurement, Numbers, Parameter, Params

PROMPT, LATE = ((-200.0, 0.0), (200.0, 0.0)), (-750.0, 750.0)
RADIUS, SPEED, SECONDS = 500.0, 200 / 3.6, 30
CENTRE = (0.0, 500.0)
NOISE_SD = 0.05
Q, Q_TURN = 10.0**2, 0.1**2
PRIOR_SD = (250.0, 250.0, 30.0, 30.0, 0.1)


def turn_state(time: Numbers) -> Array:
    """The true state (..., 5) at `time` (...) in seconds: x and y in m, their velocities in m/s,
    and the turn rate in rad/s. It starts at (-500, 500) m to the north and turns clockwise."""
    time = jnp.asarray(time)
    angle = SPEED / RADIUS * time
    s, c = jnp.sin(angle), jnp.cos(angle)
    place = [CENTRE[0] - RADIUS * c, CENTRE[1] + RADIUS * s]
    return jnp.stack([*place, SPEED * s, SPEED * c, jnp.full_like(time, -SPEED / RADIUS)], -1)


@from_recipe
def turn_model(q: Parameter = Q, q_turn: Parameter = Q_TURN, r: Parameter = NOISE_SD**2) -> Model:
    """A coordinated turn; "sensor" 0 is the pair of bearings from (-200, 0) m and (200, 0) m, and 1
    is the bearing from (-750, 750) m (its second component is always absent).

    Args:
        q: density of the white acceleration in m^2/s^3, a number or a function of `params`.
        q_turn: density of the white turn acceleration in rad^2/s^3, likewise.
        r: variance of the bearings in rad^2, likewise.
    """
    pair = _side_by_side(*(bearing_sensor(r, place) for place in PROMPT))
    late = bearing_sensor(r, LATE)
    return models.coordinated_turn(sensors=[pair, _side_by_side(late, late)], q=q, q_turn=q_turn)


@from_recipe
def turn(
    probability: float = 0.7,
    max_delay: float = 5.0,
    *,
    noise_sd: float = NOISE_SD,
    in_order: bool = False,
) -> Scenario:
    """30 s of the turn. Every second, from 0 s on, both prompt sensors are heard, and after them,
    with `probability`, the third, about a time that is uniformly up to `max_delay` s back (and
    after 0 s, so never at 0 s itself).

    Each second is two arrivals: the pair, and the late one or, if there is none, a masked row of
    the same second. Truth is the position at that second. The filters start at zero, with standard
    deviations of 250 m, 30 m/s and 0.1 rad/s.

    Args:
        probability: that there is a late measurement in a second.
        max_delay: s.
        noise_sd: standard deviation of the bearings, rad.
        in_order: the same measurements in order of validity time, as if none were late (`PFord`);
            truth is then the position at the time of the measurement. An estimate has seen
            what the other filters cannot have at that time.

    Raises:
        ValueError: a probability outside 0..1; max_delay <= 0; negative noise.
    """
    checks.at_least("probability", probability, 0.0)
    checks.at_least("1 - probability", 1 - probability, 0.0)
    checks.positive("max_delay", max_delay)
    checks.at_least("noise_sd", noise_sd, 0.0)
    seconds = np.arange(SECONDS + 1.0)
    clock = np.repeat(seconds, 2)
    sensor = np.tile(np.asarray([0, 1], np.int32), seconds.size)
    model = turn_model()

    def simulate(key: Array) -> Simulation:
        chance, wait, noise = jax.random.split(key, 3)
        heard = jax.random.bernoulli(chance, probability, seconds.shape) & (seconds > 0)
        share = 1 - jax.random.uniform(wait, seconds.shape)
        back = jnp.where(heard, share * np.minimum(max_delay, seconds), 0)
        time = jnp.stack([jnp.asarray(seconds), seconds - back], 1).ravel()
        exact = jax.vmap(model.observe, (None, 0, 0, 0))(None, turn_state(time), sensor, time)
        value = exact + noise_sd * jax.random.normal(noise, exact.shape)
        both, none = jnp.ones_like(heard), jnp.zeros_like(heard)
        mask = jnp.stack([both, both, heard, none], 1).reshape(-1, 2)
        stream = Measurement(time, value, jnp.asarray(sensor), mask)
        if not in_order:
            return Simulation(stream, turn_state(clock)[:, :2])
        order = jnp.argsort(time, stable=True)
        stream = jax.tree.map(lambda x: x[order], stream)
        return Simulation(stream, turn_state(stream.time)[:, :2])

    prior = Gaussian(jnp.zeros(5), jnp.diag(jnp.square(jnp.asarray(PRIOR_SD))))
    return Scenario(simulate, prior, 0.0)


def _side_by_side(first: Sensor, second: Sensor) -> Sensor:
    """Two sensors of one component each as one sensor of two."""

    def observe(params: Params, x: Array, t: Array) -> Array:
        return jnp.concatenate([s.observe(params, x, t) for s in (first, second)])

    def cov(params: Params, t: Array) -> Array:
        return jnp.diag(jnp.concatenate([jnp.diag(s.cov(params, t)) for s in (first, second)]))

    return Sensor(observe, cov, first.angle + second.angle)
