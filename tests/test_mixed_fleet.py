"""Radar, camera and receiver: who reports what, when, and how far off."""

import jax
import numpy as np
import pytest

import ewif_jax as ej
from ewif_jax.scenarios import mixed_fleet, mixed_fleet_model
from ewif_jax.scenarios.mixed_fleet import CAMERA, CAMERA_LATENCY, RADAR, RECEIVER

KEYS = jax.random.split(jax.random.key(3), 60)


@pytest.fixture(scope="module")
def batch():
    return ej.simulate_batch(mixed_fleet(), KEYS)


def test_each_sensor_is_heard_when_it_says(batch):
    """The radar at once, the camera after 0.5 s with late stamps, the receiver after 2 to 5 s."""
    time, _, sensor, mask = (np.asarray(x) for x in batch.measurements)
    waited = np.asarray(batch.times) - time
    assert np.all(np.diff(batch.times, axis=1) >= 0)
    np.testing.assert_allclose(waited[sensor == RADAR], 0, atol=1e-12)
    np.testing.assert_allclose(waited[sensor == CAMERA], 0.5 - CAMERA_LATENCY, atol=1e-12)
    late = waited[sensor == RECEIVER]
    assert late.min() >= 2
    assert late.max() <= 5
    assert late.max() - late.min() > 2.9
    sizes = np.asarray([3, 1, 2])[sensor]
    np.testing.assert_array_equal(mask.sum(-1), sizes)
    assert np.all(mask[..., 0])
    assert [int((sensor == s).sum()) for s in range(3)] == [3600, 3600, 1800]


def test_a_filter_of_the_world_is_consistent_and_the_cameras_clock_matters():
    """Without outliers and with the latency known NIS is 1 on average; without it the position is
    worse in the same runs."""
    batch = ej.simulate_batch(mixed_fleet(outliers=0.0), KEYS)
    at = {"prior": mixed_fleet().prior, "t0": 0.0, "times": batch.times}
    estimator = ej.replay(ej.extended(mixed_fleet_model()), 16, width=3)
    errors = []
    for latency in ([0.0, CAMERA_LATENCY, 0.0], [0.0, 0.0, 0.0]):
        trace = ej.run_batch(estimator, None, batch.measurements, latency=latency, **at)
        assert np.all(np.asarray(trace.info.status) <= ej.Status.LATE_USED)
        if latency[CAMERA]:
            normal = np.asarray(ej.nis(trace.info)).sum(1) / batch.measurements.mask[0].sum()
            assert abs(normal.mean() - 1) < 4 * normal.std() / np.sqrt(len(KEYS)) < 0.1
        square = np.sum((np.asarray(trace.mean)[..., :2] - np.asarray(batch.truth)) ** 2, -1)
        errors.append(np.sqrt(square.mean(1)))
    worse = errors[1] - errors[0]
    assert worse.mean() > 5 * worse.std() / np.sqrt(len(KEYS))


def test_what_is_no_probability_is_refused():
    with pytest.raises(ValueError, match="1 - outliers"):
        mixed_fleet(outliers=1.5)
    with pytest.raises(ValueError, match="latency"):
        mixed_fleet(latency=np.inf)
