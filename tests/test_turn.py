"""The turn of Orguner & Gustafsson: its path, and who reports what, when."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import ewif_jax as ej
from ewif_jax.scenarios import turn, turn_model, turn_state

KEYS = jax.random.split(jax.random.key(1), 500)
PLACES = np.array([[-200.0, 0.0], [200.0, 0.0], [-750.0, 750.0]])


@pytest.fixture(scope="module")
def batch():
    return ej.simulate_batch(turn(), KEYS)


def late(batch):
    """Time, value and mask (R, 31) of the third sensor, and the seconds (31,)."""
    time, value, _, mask = batch.measurements
    return time[:, 1::2], value[:, 1::2, 0], mask[:, 1::2, 0], np.arange(31.0)


def test_the_path_is_a_clockwise_circle_at_200_km_per_hour():
    x = np.asarray(turn_state(np.linspace(0, 30, 61)))
    np.testing.assert_allclose(x[0, :4], [-500.0, 500.0, 0.0, 200 / 3.6], atol=1e-9)
    np.testing.assert_allclose(np.hypot(x[:, 0], x[:, 1] - 500.0), 500.0)
    np.testing.assert_allclose(np.hypot(x[:, 2], x[:, 3]), 200 / 3.6)
    assert x[10, 0] > x[0, 0]
    model = turn_model()
    for k in (0, 17):
        moved = model.transition(None, jnp.asarray(x[k]), 0.0, 0.5)
        np.testing.assert_allclose(moved, x[k + 1], rtol=1e-9)


def test_every_second_brings_the_pair_and_perhaps_a_late_one(batch):
    time, _, sensor, mask = batch.measurements
    assert time.shape == (500, 62)
    np.testing.assert_array_equal(np.asarray(sensor).reshape(-1, 2), np.tile([0, 1], (31, 1)))
    np.testing.assert_array_equal(time[:, ::2], np.broadcast_to(np.arange(31.0), (500, 31)))
    assert np.asarray(mask)[:, ::2].all()
    assert not np.asarray(mask)[:, 1::2, 1].any()
    heard = np.asarray(late(batch)[2])
    assert not heard[:, 0].any()
    share = heard[:, 1:].mean()
    assert abs(share - 0.7) < 4 * np.sqrt(0.21 / heard[:, 1:].size)


def test_late_stamps_are_uniform_over_what_has_passed_up_to_five_seconds(batch):
    time, _, heard, second = late(batch)
    delay = second - np.asarray(time)
    room = np.minimum(5.0, second)
    share = (delay / np.maximum(room, 1))[np.asarray(heard)]
    assert share.min() > 0
    assert share.max() <= 1
    counts, _ = np.histogram(share, 10, (0, 1))
    expected = share.size / 10
    assert np.sum((counts - expected) ** 2 / expected) < 30
    np.testing.assert_array_equal(delay[~np.asarray(heard)], 0.0)


def test_bearings_are_those_of_the_path_with_the_printed_noise(batch):
    time, value, sensor, mask = jax.tree.map(np.asarray, batch.measurements)
    x = np.asarray(turn_state(time))[..., None, :2]
    seen = np.where(sensor[..., None, None] == 0, PLACES[:2], PLACES[[2, 2]])
    bearing = np.arctan2(*np.moveaxis(x - seen, -1, 0)[::-1])
    noise = (value - bearing)[mask]
    assert abs(noise.std() / 0.05 - 1) < 4 / np.sqrt(2 * noise.size)
    assert abs(noise.mean()) < 4 * 0.05 / np.sqrt(noise.size)


def test_in_order_it_is_the_same_measurements_sorted(batch):
    sorted_in = ej.simulate_batch(turn(in_order=True), KEYS)
    order = np.argsort(np.asarray(batch.measurements.time), axis=1, kind="stable")
    assert np.all(np.diff(sorted_in.measurements.time, axis=1) >= 0)
    rows = np.arange(500)[:, None]
    for a, b in zip(sorted_in.measurements, batch.measurements, strict=True):
        full = np.broadcast_to(b, (500, *np.shape(b)[-(a.ndim - 1) :]))
        np.testing.assert_allclose(a, full[rows, order], rtol=1e-12, atol=1e-12)
    here = turn_state(sorted_in.measurements.time)[..., :2]
    np.testing.assert_allclose(sorted_in.truth, here, rtol=1e-14)
    at = np.repeat(np.arange(31.0), 2)
    np.testing.assert_allclose(batch.truth, turn_state(at)[:, :2], rtol=1e-14)


def test_what_the_filters_are_told():
    prior = turn().prior
    assert prior is not None
    np.testing.assert_array_equal(prior.mean, np.zeros(5))
    np.testing.assert_allclose(np.sqrt(np.diag(prior.cov)), [250, 250, 30, 30, 0.1])
    cov = turn_model().process_cov(None, jnp.asarray(0.0), jnp.asarray(1.0))
    np.testing.assert_allclose(np.diag(cov), [100 / 3, 100 / 3, 100, 100, 0.01])


def test_the_third_sensor_alone_updates_the_extended_filter():
    """Its absent second component says nothing, and angles wrap."""
    here = np.asarray(turn_state(3.0))
    model, prior = turn_model(), ej.Gaussian(here, np.eye(5) * 100.0)
    bearing = np.arctan2(here[1] - 750.0, here[0] + 750.0)
    seen = ej.stream([3.0], [[bearing + 2 * np.pi, np.nan]], 1)
    trace = ej.run(ej.extended(model), None, seen, prior=prior, t0=3.0)
    np.testing.assert_allclose(trace.mean[0], here, atol=1e-6)
    assert trace.cov[0, 0, 0] + trace.cov[0, 1, 1] < 199.0


def test_float32():
    with jax.enable_x64(False):
        one = jax.jit(turn().simulate)(jax.random.key(0))
        assert {x.dtype.name for x in jax.tree.leaves(one)} == {"float32", "int32", "bool"}
        assert turn_state(1.5).dtype == np.float32


@pytest.mark.parametrize(
    ("given", "message"),
    [({"probability": 1.2}, "1 - probability"), ({"max_delay": 0.0}, "max_delay")],
)
def test_what_cannot_be_is_refused(given, message):
    with pytest.raises(ValueError, match=f"{message}: expected"):
        turn(**given)
