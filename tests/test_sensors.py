"""Every sensor of the package keeps what the filters rely on. A new sensor is one more row."""

import pickle
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import ewif_jax as ej
from ewif_jax.models import Sensor
from ewif_jax.models.bank import bank


class Row(NamedTuple):
    """name; build(r) -> Sensor, of noise variance r in each component; dims: of the space."""

    name: str
    build: Callable[[Any], Sensor]
    dims: int = 2


PLACE = (0.3, -0.2)


def sailing(params: Any, t: Any) -> Any:
    """Where a ship is that starts at PLACE."""
    return jnp.asarray(PLACE) + jnp.stack([0.5 * t, 0.1 * t**2])


def twice_seen(params: Any, x: Any, t: Any) -> Any:
    return jnp.stack([x[0] - x[1], x[0] * x[1]])


ROWS = (
    Row("position", lambda r: ej.models.position_sensor(r, dims=2)),
    Row("position_on_a_line", ej.models.position_sensor, dims=1),
    Row("position_of_a_ship", lambda r: ej.models.position_sensor(r, 2, position=(0.3, -0.2))),
    Row("velocity", lambda r: ej.models.velocity_sensor(r, dims=2)),
    Row("bearing", lambda r: ej.models.bearing_sensor(r, position=(0.3, -0.2))),
    Row("range", lambda r: ej.models.range_sensor(r, position=(0.3, -0.2))),
    Row("range_on_a_line", lambda r: ej.models.range_sensor(r, dims=1), dims=1),
    Row("range_rate", lambda r: ej.models.range_rate_sensor(r, PLACE, velocity=(0.1, 0.0))),
    Row("range_bearing", lambda r: ej.models.range_bearing_sensor(r, PLACE)),
    Row("range_bearing_rate", lambda r: ej.models.range_bearing_rate_sensor(r, PLACE)),
    Row("azimuth_elevation_range", ej.models.azimuth_elevation_range_sensor, dims=3),
    Row("a_ship_that_listens", lambda r: ej.models.range_bearing_rate_sensor(r, sailing)),
    Row("of_ones_own", lambda r: ej.models.sensor(twice_seen, r, size=2, angle=[True, False])),
)
STATES = (np.array([1.2, 0.7, 0.5, -0.4, 0.2, 0.1]), np.array([-2.0, 0.9, -0.3, 0.1, 0.0, 0.2]))

each = pytest.mark.parametrize("row", ROWS, ids=lambda row: row.name)


def state_of(row: Row, state: np.ndarray) -> np.ndarray:
    """A position and a velocity in the space of the sensor."""
    return np.concatenate([state[: row.dims], state[3 : 3 + row.dims]])


@each
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_shapes_and_dtypes(row, dtype):
    sensor = row.build(lambda params: params["r"])
    m = len(sensor.angle)
    seen = sensor.observe({}, jnp.asarray(state_of(row, STATES[0]), dtype), jnp.asarray(0.0, dtype))
    assert (seen.shape, seen.dtype) == ((m,), dtype)
    cov = sensor.cov({"r": jnp.asarray(0.5, dtype)}, jnp.asarray(0.0, dtype))
    assert cov.dtype == dtype
    np.testing.assert_array_equal(cov, 0.5 * np.eye(m))


@each
def test_the_slope_is_the_finite_difference(row):
    sensor = row.build(0.5)
    for state in STATES:
        x = state_of(row, state)
        slope = jax.jacfwd(lambda y: sensor.observe(None, y, 0.0))(jnp.asarray(x))
        step = 1e-6 * np.eye(x.size)
        ahead, behind = (
            np.stack([sensor.observe(None, jnp.asarray(x + s * d), 0.0) for d in step], -1)
            for s in (1, -1)
        )
        np.testing.assert_allclose(slope, (ahead - behind) / 2e-6, rtol=1e-7, atol=1e-8)


AWAY, LEAVING = STATES[0][:3] - [0.3, -0.2, 0.1], STATES[0][3:] - [0.1, 0.0, 0.0]
AT_2 = STATES[0][:2] - [0.3 + 1.0, -0.2 + 0.4]
TOLD = {
    "range": (2, ej.models.range_sensor(1.0, PLACE), [np.linalg.norm(AWAY[:2])]),
    "range in space": (3, ej.models.range_sensor(1.0, (*PLACE, 0.1)), [np.linalg.norm(AWAY)]),
    "range rate": (
        2,
        ej.models.range_rate_sensor(1.0, PLACE, velocity=(0.1, 0.0)),
        [AWAY[:2] @ LEAVING[:2] / np.linalg.norm(AWAY[:2])],
    ),
    "range, bearing": (
        2,
        ej.models.range_bearing_sensor(1.0, lambda params: jnp.asarray(PLACE)),
        [np.linalg.norm(AWAY[:2]), np.arctan2(AWAY[1], AWAY[0])],
    ),
    "a ship that sails": (
        2,
        ej.models.range_bearing_rate_sensor(1.0, sailing),
        [
            np.linalg.norm(AT_2),
            np.arctan2(AT_2[1], AT_2[0]),
            AT_2 @ (STATES[0][3:5] - [0.5, 0.4]) / np.linalg.norm(AT_2),
        ],
    ),
    "a Doppler radar in space": (
        3,
        ej.models.range_bearing_rate_sensor(1.0, (*PLACE, 0.1), (0.1, 0.0, 0.0), dims=3),
        [
            np.linalg.norm(AWAY),
            np.arctan2(AWAY[1], AWAY[0]),
            AWAY @ LEAVING / np.linalg.norm(AWAY),
        ],
    ),
    "azimuth, elevation, range": (
        3,
        ej.models.azimuth_elevation_range_sensor(1.0, (*PLACE, 0.1)),
        [
            np.arctan2(AWAY[1], AWAY[0]),
            np.arcsin(AWAY[2] / np.linalg.norm(AWAY)),
            np.linalg.norm(AWAY),
        ],
    ),
    "velocity of another": (
        3,
        ej.models.velocity_sensor(1.0, 3, velocity=(0.1, 0.0, 0.0)),
        LEAVING,
    ),
}


@pytest.mark.parametrize(("dims", "sensor", "expected"), TOLD.values(), ids=TOLD)
def test_what_a_sensor_says_after_two_seconds(dims, sensor, expected):
    x = state_of(Row("", sensor, dims), STATES[0])
    np.testing.assert_allclose(sensor.observe(None, jnp.asarray(x), 2.0), expected, rtol=1e-12)


@each
def test_nothing_is_infinite_anywhere(row):
    """Not at the sensor itself, wherever it is."""
    sensor = row.build(0.5)
    for place in ([0.0, 0.0, 0.0], [*PLACE, 0.0], [0.0, 0.0, 1.0], [1e-200, 0.0, 0.0]):
        x = jnp.asarray([*place[: row.dims], *([0.0] * row.dims)])
        assert np.isfinite(sensor.observe(None, x, 0.0)).all()
        assert np.isfinite(jax.jacrev(lambda y: sensor.observe(None, y, 0.0))(x)).all()


@each
def test_angles_are_compared_on_the_circle(row):
    sensor = row.build(0.5)
    residual = bank(sensor).residual
    m = len(sensor.angle)
    difference = residual(jnp.full(m, np.pi - 0.1), jnp.full(m, -np.pi + 0.1), jnp.int32(0))
    np.testing.assert_allclose(difference, np.where(sensor.angle, -0.2, 2 * np.pi - 0.2), rtol=1e-9)


@each
def test_a_filter_of_any_motion_takes_it_and_has_gradients(row):
    model = ej.models.constant_velocity(
        dims=row.dims, q=0.1, sensors=row.build(lambda params: params["r"])
    )
    m = len(row.build(0.5).angle)
    values = np.linspace(0.1, 1.0, 4 * m).reshape(4, m)
    stream = ej.stream(np.arange(4.0), values)
    prior = ej.Gaussian(state_of(row, STATES[0]), np.eye(2 * row.dims))
    loss = ej.likelihood_loss(ej.extended(model), stream, prior=prior, t0=0.0)
    value, slope = jax.value_and_grad(loss)({"r": jnp.asarray(0.5)})
    assert np.isfinite(value)
    assert slope["r"] != 0
    assert np.isfinite(slope["r"])


@each
@pytest.mark.parametrize("bad", [-1.0, np.nan, np.inf])
def test_what_is_no_variance_is_refused_by_name(row, bad):
    with pytest.raises(ValueError, match=r"\b(r|cov)\b"):
        row.build(bad)


@each
def test_one_made_again_is_the_same(row):
    sensor = row.build(0.5)
    assert sensor == row.build(0.5)
    assert sensor != row.build(0.6)
    assert pickle.loads(pickle.dumps(sensor)) == sensor
