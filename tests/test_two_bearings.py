"""The two rotating sensors report what their scan lines met, when their scans end."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import ewif_jax as ej
from ewif_jax.scenarios import two_bearings, two_bearings_model, two_bearings_path
from ewif_jax.scenarios.two_bearings import PERIODS, SENSORS, START

KEYS = jax.random.split(jax.random.key(4), 40)
WILD = 20.0


@pytest.fixture(scope="module")
def exact():
    """Without noise of the bearings, of a target so agile that it crosses the start of the scans;
    and its path at those times."""
    scenario = two_bearings(5.0, q=WILD, noise_sd=0.0)
    batch = ej.simulate_batch(scenario, KEYS)
    path = jax.jit(jax.vmap(lambda key, time: two_bearings_path(key, time, q=WILD)))
    return batch, np.asarray(path(KEYS, batch.measurements.time)), path


def scans(batch):
    """Sensor, period, and begin of the scan of every arrival."""
    sensor = np.asarray(batch.measurements.sensor)
    period = np.asarray(PERIODS)[sensor]
    end = np.asarray(batch.times) - np.where(sensor == 0, 5.0, 0.0)
    return sensor, period, end - period


def test_every_scan_arrives_at_its_end_or_later_in_order(exact):
    batch, _, _ = exact
    sensor, period, begin = scans(batch)
    number = begin / period
    np.testing.assert_allclose(number, np.round(number), atol=1e-9)
    for one, last in ((0, (100.0 - 5.0) / 2.6), (1, 100.0 / 2.8)):
        np.testing.assert_allclose(number[sensor == one], np.arange(int(last)), atol=1e-9)
    assert np.all(np.diff(batch.times) >= 0)
    time = np.asarray(batch.measurements.time)
    assert np.all((time >= begin) & (time <= begin + period))


def test_what_is_reported_is_where_the_scan_line_meets_the_target(exact):
    batch, path, _ = exact
    sensor, period, begin = scans(batch)
    seen = np.asarray(batch.measurements.mask)[..., 0]
    east, north = np.moveaxis(path[..., :2] - np.asarray(SENSORS)[sensor], -1, 0)
    bearing = np.arctan2(north, east)
    np.testing.assert_allclose(batch.measurements.value[..., 0], bearing, atol=1e-12)
    turned = 2 * np.pi * (np.asarray(batch.measurements.time) - begin) / period
    apart = np.angle(np.exp(1j * (turned - bearing)))
    assert np.abs(apart[seen]).max() < 1e-6


def test_what_is_masked_was_not_met(exact):
    """On a fine grid the scan line never catches up with the target."""
    batch, _, path = exact
    _, period, begin = scans(batch)
    missing = np.argwhere(~np.asarray(batch.measurements.mask)[..., 0])
    assert 0 < len(missing) < 0.05 * batch.measurements.mask.size
    places = np.asarray(SENSORS)[np.asarray(batch.measurements.sensor)]
    for run, k in missing:
        turned = np.linspace(0, 1, 20_001)
        here = path(KEYS[run][None], (begin[k] + period[k] * turned)[None])[0, :, :2]
        east, north = (np.asarray(here) - places[k]).T
        ahead = 2 * np.pi * turned - np.arctan2(north, east) % (2 * np.pi)
        caught = (ahead[:-1] < 0) & (ahead[1:] > 0) & (np.diff(ahead) < 3)
        assert not caught.any()


def test_truth_is_the_position_at_the_arrival(exact):
    batch, _, path = exact
    times = np.broadcast_to(batch.times, batch.truth.shape[:2])
    np.testing.assert_allclose(batch.truth, path(KEYS, times)[..., :2], atol=1e-9)
    assert two_bearings(5.0).clock == "arrival"


def test_the_target_moves_as_its_model_says():
    """Mean and covariance of the state after 0.33 s, 2 s and 30 s, within 4 standard errors."""
    runs, times = 5_000, jnp.asarray([0.33, 2.0, 30.0])
    draw = jax.jit(jax.vmap(lambda key: two_bearings_path(key, times, q=0.7, length=31.0)))
    states = np.asarray(draw(jax.random.split(jax.random.key(0), runs)))
    model = two_bearings_model(q=0.7)
    for k, t in enumerate(times):
        mean = model.transition(None, jnp.asarray(START), 0.0, t)
        cov = np.asarray(model.process_cov(None, jnp.asarray(0.0), t))
        spread = np.sqrt(np.diag(cov))
        off = (states[:, k] - np.asarray(mean)) / spread
        assert np.abs(off.mean(0)).max() < 4 / np.sqrt(runs)
        correlation = cov / np.outer(spread, spread)
        assert np.abs(off.T @ off / runs - correlation).max() < 4 * np.sqrt(2 / runs)


def test_bearings_have_the_noise_they_should():
    keys = jax.random.split(jax.random.key(9), 40)
    noisy = ej.simulate_batch(two_bearings(), keys)
    clean = ej.simulate_batch(two_bearings(noise_sd=0.0), keys)
    np.testing.assert_array_equal(noisy.measurements.time, clean.measurements.time)
    noise = np.rad2deg(noisy.measurements.value - clean.measurements.value).ravel()
    assert abs(noise.std() / 0.1 - 1) < 4 / np.sqrt(2 * noise.size)
    assert abs(noise.mean()) < 4 * 0.1 / np.sqrt(noise.size)


def test_float32():
    with jax.enable_x64(False):
        one = jax.jit(two_bearings(10.0).simulate)(jax.random.key(0))
        assert {x.dtype.name for x in jax.tree.leaves(one)} == {"float32", "int32", "bool"}
        assert np.isfinite(one.measurements.value).all()


@pytest.mark.parametrize(
    ("given", "message"),
    [({"delay": -1.0}, "delay"), ({"noise_sd": -0.1}, "noise_sd"), ({"length": 2.0}, "length")],
)
def test_what_cannot_be_is_refused(given, message):
    with pytest.raises(ValueError, match=f"{message}: expected"):
        two_bearings(**given)
