"""A target that turns and speeds as it likes, seen by two sensors, one of them late: Fig. 2 of
Shulami & Sigalov."""

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ewif_jax import checks, models
from ewif_jax.models import Model, Sensor
from ewif_jax.monte_carlo import Scenario, Simulation
from ewif_jax.recipe import from_recipe
from ewif_jax.scenarios.delays import deliver, uniform_delays
from ewif_jax.types import Measurement, Numbers, Parameter, Params

LENGTH, SETTLED = 60.0, 5.0
SLOW, FAST = 0.5, 0.15
PROMPT_SD, LATE_SD = (2.0, 6.0), (2.0, 6.0)
DELAY = (0.3, 2.5)


def arbitrary_path(time: Numbers) -> Array:
    """Position (..., 2) in m at `time` (...) in seconds: smooth, with speeds from 4 to 10 m/s and
    turns to either side."""
    grid, east, north = _target_path()
    time = jnp.asarray(time)
    return jnp.stack([jnp.interp(time, grid, east), jnp.interp(time, grid, north)], -1)


def arbitrary_noise(sensor: Numbers, time: Numbers) -> Array:
    """Noise standard deviation () in m, the same on both axes: it swells and shrinks along the way,
    in opposite phase for the two sensors."""
    low, high = jnp.asarray(PROMPT_SD), jnp.asarray(LATE_SD)
    low, high = jnp.where(sensor == 0, low, high)
    phase = jnp.cos(2 * jnp.pi * time / 25 + jnp.pi * sensor)
    return low + (high - low) * (1 + phase) / 2


@from_recipe
def arbitrary_target_model(q: Parameter = 0.0) -> Model:
    """Constant acceleration in two dimensions, the paper's model; sensor 0 is prompt, 1 late."""

    def sensor(number: int) -> Sensor:
        def cov(params: Params, t: Array) -> Array:
            del params
            return jnp.square(arbitrary_noise(number, t)) * jnp.eye(2)

        return Sensor(lambda params, x, t: x[:2], cov, (False, False), lambda n: np.eye(2, n))

    return models.constant_acceleration(sensors=[sensor(0), sensor(1)], q=q, dims=2)


@from_recipe
def arbitrary_target(lag: float = 0.0, late_used: bool = True) -> Scenario:
    """A minute of the target. Both the noise and the sampling interval of the sensors vary along
    the way; sensor 1 arrives 0.3 to 2.5 s late, sensor 0 at once.

    The paper describes its scenario in words only; this one follows them. Reports are due at each
    arrival, for the time `lag` seconds before it: 0 is the filter, 1 the paper's smoother. Truth is
    the position at that time, NaN (not scored) before 5 s.

    Args:
        lag: seconds, >= 0.
        late_used: False masks sensor 1; its arrivals stay, so that all regimes report alike.
    """
    checks.at_least("lag", lag, 0.0)
    prompt, late = _sampling_times(0.0), _sampling_times(np.pi)
    time = jnp.asarray(np.concatenate([prompt, late]))
    sensor = jnp.asarray(np.repeat([0, 1], [prompt.size, late.size]))
    seen, spread = arbitrary_path(time), jax.vmap(arbitrary_noise)(sensor, time)

    def simulate(key: Array) -> Simulation:
        noise, wait = jax.random.split(key)
        value = seen + spread[:, None] * jax.random.normal(noise, seen.shape)
        waited = jnp.where(sensor == 1, uniform_delays(wait, *DELAY, time.size), 0.0)
        arrived = deliver(time, value, waited, sensor=sensor)
        stream: Measurement = arrived.measurements
        if not late_used:
            stream = stream._replace(mask=stream.mask & (stream.sensor == 0)[:, None])
        report = arrived.arrival - lag
        settled = jnp.broadcast_to((report > SETTLED)[:, None], (report.shape[0], 2))
        return Simulation(stream, jnp.where(settled, arbitrary_path(report), jnp.nan), report)

    return Scenario(simulate, None, 0.0)


def _sampling_times(phase: float) -> np.ndarray:
    """Times between 0 and `LENGTH` at intervals that swing from `FAST` to `SLOW`."""
    times = [0.0]
    while times[-1] < LENGTH:
        swing = (1 + np.sin(2 * np.pi * times[-1] / 20 + phase)) / 2
        times.append(times[-1] + FAST + (SLOW - FAST) * swing)
    return np.asarray(times[:-1])


def _target_path() -> tuple[Array, Array, Array]:
    """A fine grid of times, and the position there by integrating speed and heading."""
    grid = jnp.linspace(0.0, LENGTH + DELAY[1], 6251)
    heading = 1.2 * jnp.sin(0.13 * grid) - 0.9 * jnp.sin(0.23 * grid + 1.0) + 0.04 * grid
    speed = 7 + 2.5 * jnp.sin(0.17 * grid) + jnp.sin(0.31 * grid + 2.0)
    step = jnp.diff(grid)

    def integral(rate: Array) -> Array:
        return jnp.concatenate([jnp.zeros(1), jnp.cumsum(step * (rate[1:] + rate[:-1]) / 2)])

    return grid, integral(speed * jnp.cos(heading)), integral(speed * jnp.sin(heading))
