"""A sensor with a bias, or one that counts from where it is, is a plain one of other data."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import ewif_jax as ej
from ewif_jax.models import biased, constant_velocity, position_sensor, velocity_sensor
from laws.cases import close

PARAMS = {"bias": np.array([0.5, -1.0]), "q": 0.3}
TIMES = np.array([0.0, 0.7, 1.5, 1.1, 2.0])
PRIOR = ej.Gaussian(np.zeros(4), 4.0 * np.eye(4))
VALUES = np.random.default_rng(0).normal(size=(5, 2))
SENSOR = np.array([0, 1, 0, 0, 1])
VELOCITY = velocity_sensor(0.3, dims=2)


def ship(params, t):
    return jnp.stack([0.4 * t, 1.0 - t**2])


SHIFTS = {
    "biased": (
        biased(position_sensor(0.5, dims=2), lambda params: params["bias"]),
        np.broadcast_to(PARAMS["bias"], (5, 2)),
    ),
    "from a ship": (
        position_sensor(0.5, dims=2, position=ship),
        -np.stack([0.4 * TIMES, 1.0 - TIMES**2], -1),
    ),
    "both": (
        biased(position_sensor(0.5, dims=2, position=ship), PARAMS["bias"]),
        PARAMS["bias"] - np.stack([0.4 * TIMES, 1.0 - TIMES**2], -1),
    ),
}
METHODS = {
    "kalman": lambda model: ej.al1(model, 4),
    "information": ej.information,
    "ewif": lambda model: ej.ewif(model, 2.0),
    "unscented": ej.unscented,
}
SLOW = ("information", "unscented")
"""Checked with --all."""


def model_of(sensor):
    return constant_velocity(sensors=[sensor, VELOCITY], q=lambda p: p["q"], dims=2)


@pytest.mark.parametrize(("sensor", "shift"), SHIFTS.values(), ids=SHIFTS)
@pytest.mark.parametrize(
    "build",
    [
        pytest.param(b, id=n, marks=pytest.mark.slow if n in SLOW else ())
        for n, b in METHODS.items()
    ],
)
def test_it_is_a_plain_sensor_of_other_data(sensor, shift, build):
    stream = ej.stream(TIMES, VALUES, sensor=SENSOR)
    less = VALUES - np.where(SENSOR[:, None] == 0, shift, 0)
    plain = ej.stream(TIMES, less, sensor=SENSOR)
    found = ej.run(build(model_of(sensor)), PARAMS, stream, prior=PRIOR, t0=0.0)
    reference = build(model_of(position_sensor(0.5, dims=2)))
    expected = ej.run(reference, PARAMS, plain, prior=PRIOR, t0=0.0)
    close(found.mean, expected.mean)
    close(found.cov, expected.cov)
    close(found.info.innovation, expected.info.innovation)


def test_least_squares_take_it_too():
    sensor, shift = SHIFTS["biased"]
    stream, plain = (ej.stream(TIMES, v) for v in (VALUES, VALUES - shift))
    found, expected = (
        ej.batch_wls(model_of(s), PARAMS, rows, TIMES[:2], weight=lambda p, a, b: 1.0)
        for s, rows in ((sensor, stream), (position_sensor(0.5, dims=2), plain))
    )
    close(found.mean, expected.mean)


def test_the_slope_in_the_bias_is_the_finite_difference():
    estimator = ej.kalman(model_of(SHIFTS["biased"][0]))
    stream = ej.stream(TIMES, VALUES, sensor=SENSOR)

    @jax.jit
    def total(bias):
        trace = ej.run(estimator, {**PARAMS, "bias": bias}, stream, prior=PRIOR, t0=0.0)
        return jnp.sum(trace.info.log_likelihood)

    slope = jax.grad(total)(jnp.asarray(PARAMS["bias"]))
    for k in range(2):
        d = 1e-5 * np.eye(2)[k]
        numeric = (total(PARAMS["bias"] + d) - total(PARAMS["bias"] - d)) / 2e-5
        np.testing.assert_allclose(slope[k], numeric, rtol=1e-6)


def test_angles_stay_angles():
    sensor = biased(ej.models.bearing_sensor(0.1), 0.3)
    assert sensor.angle == (True,)
    assert sensor.matrix is None
    np.testing.assert_allclose(sensor.observe(None, jnp.asarray([1.0, 1.0]), 0.0), np.pi / 4 + 0.3)


REFUSED = {
    "another size": (
        lambda: biased(VELOCITY, [1.0]),
        "bias: expected shape (2,), got shape (1,)",
    ),
    "a number for two": (lambda: biased(VELOCITY, 1.0), "bias: expected shape (2,), got shape ()"),
    "no number": (
        lambda: biased(VELOCITY, [1.0, np.nan]),
        "bias: expected finite numbers, got nan at index 1",
    ),
    "no sensor": (lambda: biased(1.0, 1.0), "sensor: expected a Sensor, got a float"),
}


@pytest.mark.parametrize(("build", "said"), REFUSED.values(), ids=REFUSED)
def test_what_is_refused(build, said):
    with pytest.raises(ValueError, match="expected") as error:
        build()
    assert str(error.value) == said
