"""A target seen by a radar, a camera whose clock is off, and a receiver that reports late."""

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

RADAR, CAMERA, RECEIVER = 0, 1, 2
RADAR_PLACE, CAMERA_PLACE = (0.0, 0.0), (1500.0, -400.0)
RADAR_VAR, CAMERA_VAR, RECEIVER_VAR = (25.0**2, 0.02**2, 1.0**2), 0.005**2, 8.0**2
START, START_SD = (600.0, 500.0, 15.0, -6.0), (50.0, 50.0, 5.0, 5.0)
Q = 0.5
CAMERA_LATENCY = 0.4
OUTLIER_SDS = 30.0
SECONDS = 60


@from_recipe
def mixed_fleet_model(q: Parameter = Q) -> Model:
    """Nearly constant velocity in the plane, (x, y, vx, vy); sensor 0 is a radar at (0, 0) (range,
    bearing and range rate), 1 a camera at (1500, -400) m (a bearing), 2 the target's own receiver
    (its position).

    Args:
        q: density of the white acceleration in m^2/s^3, a number or a function of `params`.
    """
    radar = models.range_bearing_rate_sensor(RADAR_VAR, RADAR_PLACE)
    camera = models.bearing_sensor(CAMERA_VAR, CAMERA_PLACE)
    receiver = models.position_sensor(RECEIVER_VAR, dims=2)
    return models.constant_velocity(sensors=[radar, camera, receiver], q=q, dims=2)


@from_recipe
def mixed_fleet(outliers: float = 0.05, latency: float = CAMERA_LATENCY) -> Scenario:
    """60 s of a target that starts at (600, 500) m with (15, -6) m/s, up to 50 m and 5 m/s.

    The radar sees it every second and is heard at once; the camera every second in between, heard
    after 0.5 s, with stamps that are `latency` late; the receiver every 2 s, heard 2 to 5 s later.
    A measurement is an outlier with probability `outliers`: its error is 30 times as wide. Truth is
    the position when a measurement arrives, and estimates are reported then.

    Args:
        outliers: probability, 0 to 1.
        latency: of the camera's stamps, s.

    Raises:
        ValueError: a probability outside 0..1; a latency that is not finite.
    """
    checks.at_least("outliers", outliers, 0.0)
    checks.at_least("1 - outliers", 1 - outliers, 0.0)
    checks.finite("latency", latency)
    seconds = np.arange(1.0, SECONDS + 1)
    time = np.concatenate([seconds, seconds - 0.5, seconds[1::2] - 0.25])
    sensor = np.repeat(np.asarray([RADAR, CAMERA, RECEIVER], np.int32), [60, 60, 30])
    has = np.asarray([3, 1, 2])[sensor][:, None] > np.arange(3)
    noise_sd = np.zeros((3, 3))
    for k, variances in enumerate((RADAR_VAR, (CAMERA_VAR,), (RECEIVER_VAR,) * 2)):
        noise_sd[k, : len(variances)] = np.sqrt(variances)
    model = mixed_fleet_model()

    def simulate(key: Array) -> Simulation:
        begin, moves, wait, chance, wild, noise = jax.random.split(key, 6)
        delay = jnp.where(sensor == CAMERA, 0.5, 0.0)
        waited = jax.random.uniform(wait, time.shape, minval=2.0, maxval=5.0)
        arrival = time + jnp.where(sensor == RECEIVER, waited, delay)
        first = jnp.asarray(START) + jnp.asarray(START_SD) * jax.random.normal(begin, (4,))
        path = drawn_path(model, moves, first, jnp.concatenate([jnp.asarray(time), arrival]))
        seen, shown = path[: time.size], path[time.size :, :2]
        exact = jax.vmap(model.observe, (None, 0, 0, 0))(None, seen, sensor, time)
        is_outlier = jax.random.bernoulli(chance, outliers, time.shape)
        error = jax.random.normal(noise, exact.shape) * noise_sd[sensor]
        error += jnp.where(is_outlier[:, None], OUTLIER_SDS, 0.0) * (
            jax.random.normal(wild, exact.shape) * noise_sd[sensor]
        )
        value = jnp.where(has, exact + error, 0)
        stamps = time + jnp.where(sensor == CAMERA, latency, 0.0)
        order = jnp.argsort(arrival, stable=True)
        stream = Measurement(jnp.asarray(stamps), value, jnp.asarray(sensor), jnp.asarray(has))
        stream, shown, arrival = jax.tree.map(lambda x: x[order], (stream, shown, arrival))
        return Simulation(stream, shown, arrival)

    prior = Gaussian(jnp.asarray(START), jnp.diag(jnp.square(jnp.asarray(START_SD))))
    return Scenario(simulate, prior, 0.0)
