"""The random walk of Yoder et al., section 4.1: irregular measurements that arrive late."""

import jax
import jax.numpy as jnp
from jax import Array, lax

from ewif_jax import checks, models
from ewif_jax.models import Model, position_sensor
from ewif_jax.monte_carlo import Scenario, Simulation
from ewif_jax.recipe import from_recipe
from ewif_jax.scenarios.delays import deliver, exponential_delays, poisson_times
from ewif_jax.types import Gaussian, Numbers, Parameter


@from_recipe
def random_walk_model(q: Parameter = 25.0, r: Parameter = 2500.0) -> Model:
    """The model that is right for `random_walk`; q in m^2/s and r in m^2, numbers or functions of
    `params`."""
    return models.random_walk(sensors=position_sensor(r), q=q)


@from_recipe
def random_walk(
    q: Parameter = 25.0,
    r: float = 2500.0,
    mean_interval: float = 0.2,
    mean_delay: Numbers = 4.0,
    steps: int = 5000,
) -> Scenario:
    r"""A position driven by white noise, :math:`w \sim N(0, q\,\Delta t)`, measured at the events
    of a Poisson process and delayed by exponential times.

    Truth is the position at the newest validity time that has arrived, which is where Yoder et al.
    compare all filters. The start, 0 m at 0 s, is known. The defaults are Fig. 4b.

    Args:
        q: process noise sigma_Q^2 in m^2/s.
        r: measurement variance sigma_R^2 in m^2.
        mean_interval: Delta T_P in seconds.
        mean_delay: Delta T_D in seconds, >= 0.
        steps: number of measurements, all of which arrive.
    """
    checks.at_least("q", q, 0.0)
    checks.positive("r", r)

    def simulate(key: Array) -> Simulation:
        when, motion, noise, wait = jax.random.split(key, 4)
        time = poisson_times(when, mean_interval, steps)
        spread = jnp.sqrt(q * jnp.diff(time, prepend=0.0))
        position = jnp.cumsum(spread * jax.random.normal(motion, (steps,)))[:, None]
        value = position + jnp.sqrt(r) * jax.random.normal(noise, (steps, 1))
        arrived = deliver(time, value, exponential_delays(wait, mean_delay, steps))
        newest = lax.cummax(arrived.order)
        return Simulation(arrived.measurements, position[newest])

    return Scenario(simulate, Gaussian(jnp.zeros(1), jnp.zeros((1, 1))), 0.0)
