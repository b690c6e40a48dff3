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
from ewif_jax.models.sensors import bank


class Row(NamedTuple):
    """name; build(r) -> Sensor, of noise variance r in each component; dims: of the space."""

    name: str
    build: Callable[[Any], Sensor]
    dims: int = 2


ROWS = (
    Row("position", lambda r: ej.models.position_sensor(r, dims=2)),
    Row("position_on_a_line", ej.models.position_sensor, dims=1),
    Row("bearing", lambda r: ej.models.bearing_sensor(r, position=(0.3, -0.2))),
)
STATES = (np.array([1.2, 0.7, -0.4, 0.2]), np.array([-2.0, 0.9, 0.1, 0.0]))

each = pytest.mark.parametrize("row", ROWS, ids=lambda row: row.name)


def state_of(row: Row, state: np.ndarray) -> np.ndarray:
    """A position and a velocity in the space of the sensor."""
    return np.concatenate([state[: row.dims], state[2 : 2 + row.dims]])


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


@each
def test_nothing_is_infinite_anywhere(row):
    """Not at the sensor itself, wherever it is."""
    sensor = row.build(0.5)
    for place in ([0.0, 0.0], [0.3, -0.2]):
        x = jnp.asarray([*place[: row.dims], *([0.0] * row.dims)])
        assert np.isfinite(sensor.observe(None, x, 0.0)).all()
        assert np.isfinite(jax.jacrev(lambda y: sensor.observe(None, y, 0.0))(x)).all()


@each
def test_angles_are_compared_on_the_circle(row):
    sensor = row.build(0.5)
    residual = bank(sensor)[2]
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
    with pytest.raises(ValueError, match=r"\br\b"):
        row.build(bad)


@each
def test_one_made_again_is_the_same(row):
    sensor = row.build(0.5)
    assert sensor == row.build(0.5)
    assert sensor != row.build(0.6)
    assert pickle.loads(pickle.dumps(sensor)) == sensor
