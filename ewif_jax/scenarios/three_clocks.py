"""A vehicle on a line, seen by three position sensors, two of whose clocks are off."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ewif_jax import checks, models
from ewif_jax.models import Model
from ewif_jax.monte_carlo import Scenario, Simulation
from ewif_jax.recipe import from_recipe
from ewif_jax.scenarios.paths import drawn_path
from ewif_jax.types import Gaussian, Measurement, Parameter

LATENCIES = (0.0, 0.4, -0.25)
Q, R = 0.1, 1.0
START, START_SD = (0.0, 8.0), (10.0, 1.0)
SECONDS = 60
TRANSPORT, MAX_DELAY = 0.5, 2.0


@from_recipe
def three_clocks_model(q: Parameter = Q, r: float = R) -> Model:
    """Nearly constant velocity on a line, (x, v), seen by three sensors of position.

    Args:
        q: density of the white acceleration in m^2/s^3, a number or a function of `params`.
        r: variance of each sensor in m^2.
    """
    return models.constant_velocity(sensors=[models.position_sensor(r)] * 3, q=q)


@from_recipe
def three_clocks(latencies: Sequence[float] = LATENCIES) -> Scenario:
    """60 s of a vehicle at 8 m/s, up to 1 m/s. Each sensor sees it once a second, in turns.

    A measurement is heard after 0.5 s, one of the third sensor up to 2 s later than that. Stamps of
    sensor k are `latencies[k]` seconds late (negative: early). Truth is the position when a
    measurement arrives, and estimates are reported then. Nothing is seen in the first two seconds,
    so that a wrong latency moves no measurement before the prior.

    Args:
        latencies: of the three sensors, s.

    Raises:
        ValueError: not three latencies, or one that is not finite.
    """
    shift = np.asarray(latencies, float)
    checks.shape("latencies", shift, (3,))
    checks.finite("latencies", shift)
    time = 2.0 + np.arange(3 * SECONDS) / 3
    sensor = np.tile(np.arange(3, dtype=np.int32), SECONDS)
    model = three_clocks_model()

    def simulate(key: Array) -> Simulation:
        begin, moves, wait, noise = jax.random.split(key, 4)
        waited = jax.random.uniform(wait, time.shape, maxval=MAX_DELAY)
        arrival = time + TRANSPORT + jnp.where(sensor == 2, waited, 0.0)
        first = jnp.asarray(START) + jnp.asarray(START_SD) * jax.random.normal(begin, (2,))
        path = drawn_path(model, moves, first, jnp.concatenate([jnp.asarray(time), arrival]))[:, :1]
        value = path[: time.size] + np.sqrt(R) * jax.random.normal(noise, (time.size, 1))
        order = jnp.argsort(arrival, stable=True)
        rows = (time + shift[sensor], value, sensor, np.ones((time.size, 1), bool))
        stream = Measurement(*(jnp.asarray(x)[order] for x in rows))
        return Simulation(stream, path[time.size :][order], arrival[order])

    prior = Gaussian(jnp.asarray(START), jnp.diag(jnp.square(jnp.asarray(START_SD))))
    return Scenario(simulate, prior, 0.0)
