"""A target between two rotating bearing sensors, one of them late: Pornsarayouth & Yamakita,
sections 5 and 6."""

import math

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from ewif_jax import checks, models
from ewif_jax.models import Model, bearing_sensor
from ewif_jax.monte_carlo import Scenario, Simulation
from ewif_jax.recipe import from_recipe
from ewif_jax.types import Gaussian, Measurement, Numbers, Parameter

SENSORS = ((-200.0, 0.0), (200.0, 0.0))
PERIODS = (2.6, 2.8)
START = (-150.0, 150.0, 6.0, 1.0)
GUESS = (-150.0, 160.0, 6.0, 1.0)
GUESS_SD = (10.0, 10.0, 2.0, 2.0)
NOISE_SD = math.radians(0.1)
Q, LENGTH = 0.1, 100.0
FINE = 0.05
HALVINGS = 40


@from_recipe
def two_bearings_model(q: Parameter = Q, r: Parameter = NOISE_SD**2) -> Model:
    """Constant velocity in the plane, seen by bearing sensors at (-200, 0) m and (200, 0) m.

    Args:
        q: density of the white acceleration in m^2/s^3, a number or a function of `params`.
        r: variance of the bearings in rad^2, likewise.
    """
    sensors = [bearing_sensor(r, place) for place in SENSORS]
    return models.constant_velocity(sensors=sensors, q=q, dims=2)


def two_bearings_path(key: Array, time: Numbers, q: float = Q, length: float = LENGTH) -> Array:
    """The target's state (T, 4) at `time` (T,) in the run that `two_bearings` draws from `key`: x
    and y in m, their velocities in m/s.

    Between points 0.05 s apart, where it is drawn exactly, the path is the cubic through their
    positions and velocities; that is off by less than a millimetre.
    """
    motion, _ = jax.random.split(key)
    return _flight_at(_target_flight(motion, q, length), jnp.asarray(time))


@from_recipe
def two_bearings(
    delay: float = 0.0, *, q: float = Q, noise_sd: float = NOISE_SD, length: float = LENGTH
) -> Scenario:
    r"""100 s of a target at nearly constant velocity, seen by two rotating bearing sensors.

    Each scan line starts to the east (along x) and turns once, counterclockwise, in T = 2.6 s and
    2.8 s. It meets the target at the time t for which

    .. math::
        2 \pi (t - t_{scan}) / T = \mathrm{atan2}(y(t) - y_s, x(t) - x_s) \mod 2 \pi \quad (55)

    and the bearing of that time is reported at the end of the scan: it is late even without a
    delay. In a scan during which the target slips northwards through the starting direction there
    may be no such time; then nothing is reported (the measurement is masked). Truth is the position
    at the arrival, to which the filter has moved (clock "arrival").

    Args:
        delay: how much later than the end of its scan sensor 0 reports, in seconds: 0, 5 and 10 in
            the paper.
        q: density of the white acceleration in m^2/s^3.
        noise_sd: standard deviation of the bearings, rad.
        length: s; only what arrives by then is part of the stream.

    The start is (-150, 150) m with (6, 1) m/s, and the filters are told (-150, 160) m. The paper
    leaves open q, what the "resolution of 0.1 degrees" means, the variances of the start and the
    length; here they are 0.1 m^2/s^3, a standard deviation, (10, 10, 2, 2)^2 and 100 s.

    Deviations: (55) leaves out the position of the sensor.

    Raises:
        ValueError: a negative delay, q or noise; a length in which no scan ends.
    """
    checks.at_least("delay", delay, 0.0)
    checks.at_least("q", q, 0.0)
    checks.at_least("noise_sd", noise_sd, 0.0)
    begin, sensor, arrival = _scan_timetable(delay, length)
    steps = arrival.size
    checks.require(steps > 0, "length", "time for one scan to end", length)
    places, period = jnp.asarray(SENSORS)[sensor], jnp.asarray(PERIODS)[sensor]

    def simulate(key: Array) -> Simulation:
        motion, noise = jax.random.split(key)
        flight = _target_flight(motion, q, length)
        time, seen = _scan_crossings(flight, jnp.asarray(begin), period, places)
        bearing = _bearing_from(flight, places, time)
        value = bearing + noise_sd * jax.random.normal(noise, (steps,))
        stream = Measurement(time, value[:, None], jnp.asarray(sensor), seen[:, None])
        return Simulation(
            stream, _flight_at(flight, jnp.asarray(arrival))[:, :2], jnp.asarray(arrival)
        )

    prior = Gaussian(jnp.asarray(GUESS), jnp.diag(jnp.square(jnp.asarray(GUESS_SD))))
    return Scenario(simulate, prior, 0.0, "arrival")


def _scan_timetable(delay: float, length: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """When each scan begins, its sensor, and when its bearing arrives, in the order of arrival."""
    counts = [int(length / period) + 1 for period in PERIODS]
    sensor = np.repeat(np.arange(2, dtype=np.int32), counts)
    number = np.concatenate([np.arange(count) for count in counts])
    period = np.asarray(PERIODS)[sensor]
    arrival = (number + 1) * period + np.where(sensor == 0, delay, 0.0)
    order = np.argsort(arrival, kind="stable")
    order = order[arrival[order] <= length]
    return (number * period)[order], sensor[order], arrival[order]


def _target_flight(key: Array, q: float, length: float) -> Array:
    """States (K, 4) every `FINE` s from 0 on: integrated white acceleration, exactly."""
    steps = math.ceil(length / FINE) + 1
    push, slip = jax.random.normal(key, (2, steps, 2))
    gained = math.sqrt(q * FINE) * push
    # The position gained by white acceleration is half of what the velocity gains times the step,
    # plus a part that is independent of it with variance q dt^3 / 12: both together have the exact
    # covariance of the integrals.
    moved = FINE / 2 * gained + math.sqrt(q * FINE**3 / 12) * slip
    start = jnp.asarray(START)[None]
    velocity = start[:, 2:] + _from_zero(gained)
    position = start[:, :2] + _from_zero(FINE * velocity[:-1] + moved)
    return jnp.concatenate([position, velocity], 1)


def _from_zero(steps: Array) -> Array:
    return jnp.concatenate([jnp.zeros_like(steps[:1]), jnp.cumsum(steps, 0)])


def _flight_at(flight: Array, time: Array) -> Array:
    """The state (T, 4) at `time` (T,), by cubic interpolation."""
    index = jnp.clip((time / FINE).astype(int), 0, flight.shape[0] - 2)
    s = (time / FINE - index)[:, None]
    (a, va), (b, vb) = (jnp.split(flight[index + k], 2, axis=1) for k in (0, 1))
    va, vb = FINE * va, FINE * vb
    c, d = 3 * (b - a) - 2 * va - vb, 2 * (a - b) + va + vb
    position = a + s * (va + s * (c + s * d))
    velocity = (va + s * (2 * c + 3 * s * d)) / FINE
    return jnp.concatenate([position, velocity], 1)


def _bearing_from(flight: Array, places: Array, time: Array) -> Array:
    east, north = (_flight_at(flight, time)[:, :2] - places).T
    return jnp.arctan2(north, east)


def _scan_crossings(
    flight: Array, begin: Array, period: Array, places: Array
) -> tuple[Array, Array]:
    """When each scan line meets the target, and whether it does: by bisection."""

    def ahead(time: Array) -> Array:
        scan = 2 * jnp.pi * (time - begin) / period
        return scan - _bearing_from(flight, places, time) % (2 * jnp.pi)

    def halve(_: int, bounds: tuple[Array, Array]) -> tuple[Array, Array]:
        low, high = bounds
        middle = (low + high) / 2
        past = ahead(middle) > 0
        return jnp.where(past, low, middle), jnp.where(past, middle, high)

    low, high = lax.fori_loop(0, HALVINGS, halve, (begin, begin + period))
    time = (low + high) / 2
    return time, jnp.abs(ahead(time)) < 0.01
