"""Latencies from data: the world, the descents of many data sets, and what the tables say."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ewif_jax.monte_carlo import simulate_batch
from ewif_jax.scenarios import three_clocks, three_clocks_model
from ewif_jax.study.papers.latency import runs as runs_of
from ewif_jax.study.papers.latency import study
from ewif_jax.study.shared.fits import fitted


def test_stamps_are_off_by_the_latencies_and_arrivals_are_not():
    keys = jax.random.split(jax.random.key(0), 3)
    honest, off = (
        simulate_batch(three_clocks(shift), keys) for shift in ((0.0, 0.0, 0.0), (0.0, 0.4, -0.25))
    )
    shift = np.asarray(off.measurements.time) - np.asarray(honest.measurements.time)
    np.testing.assert_allclose(shift, np.asarray([0, 0.4, -0.25])[off.measurements.sensor])
    np.testing.assert_array_equal(off.measurements.value, honest.measurements.value)
    delay = np.asarray(off.times) - np.asarray(honest.measurements.time)
    is_third = np.asarray(off.measurements.sensor) == 2
    np.testing.assert_allclose(delay[~is_third], 0.5, atol=1e-9)
    assert delay[is_third].min() >= 0.5
    assert delay.max() <= 2.5
    assert np.all(np.diff(off.times) >= 0)
    assert three_clocks_model().sensors == 3
    with pytest.raises(ValueError, match="latencies: expected"):
        three_clocks((0.0, np.nan, 0.0))


def test_the_target_moves_as_its_model_says():
    """What is left of values 1 s apart of one sensor has the variance of integrated noise."""
    batch = simulate_batch(three_clocks((0.0, 0.0, 0.0)), jax.random.split(jax.random.key(1), 400))
    values = np.asarray(batch.measurements.value)[..., 0]
    prompt = values[np.asarray(batch.measurements.sensor) == 0].reshape(400, 60)
    second = prompt[:, 2:] - 2 * prompt[:, 1:-1] + prompt[:, :-2]
    # 2 q / 3 of two seconds of white acceleration, and 6 r of three measurements.
    variance, count = second.var(), second.size
    assert abs(variance / (2 * 0.1 / 3 + 6) - 1) < 4 * np.sqrt(2 * 4 / count)


def test_each_data_set_has_its_own_minimum():
    data = {"at": np.asarray([[1.0, -2.0], [0.5, 0.0], [3.0, 3.0]]), "by": np.asarray([1.0, 4, 9])}

    def loss(x, own):
        return own["by"] * jnp.sum(jnp.cosh(x - own["at"]))

    asked = []
    found = fitted(loss, np.zeros(2), data, lambda *x: asked.append(x), at_once=2)
    np.testing.assert_allclose(found.point, data["at"], atol=1e-5)
    np.testing.assert_allclose(found.least, 2 * data["by"])
    assert asked == [(2, 3), (3, 3)]
    assert 2 < found.turns < 60


def test_the_table_counts_the_intervals_that_hold():
    off = np.asarray([[0.0, 0.1, 0.0], [0.1, 0.0, 0.0], [-0.1, 0.0, 0.3], [0.0, -0.1, 0.0]])
    fits = {"point": runs_of.TRUTH + off, "error": np.full((4, 3), 0.1), "bound": np.full(3, 0.05)}
    rows = study._parameter_rows(fits)
    assert [row["95 % intervals that hold"].value for row in rows] == [1.0, 1.0, 0.75]
    assert rows[0]["scatter"].value == pytest.approx(off[:, 0].std(ddof=1))


def test_the_grid_is_around_the_truth():
    points = runs_of.grid_points()
    assert points.shape == (5 * 13 * 13, 3)
    np.testing.assert_allclose(points.mean(0), runs_of.TRUTH)
    np.testing.assert_allclose(points[len(points) // 2], runs_of.TRUTH)
