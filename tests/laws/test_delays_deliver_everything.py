"""A delivery is a rearrangement of what was measured, in order of arrival."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ewif_jax.scenarios.delays import (
    by_sensor,
    deliver,
    exponential_delays,
    fixed_delays,
    losses,
    poisson_times,
    regular_times,
    uniform_delays,
)

KEY = jax.random.key(0)


def test_a_delivery_is_sorted_by_arrival_and_loses_nothing_else():
    times = poisson_times(KEY, 0.5, 200)
    sensor = jnp.arange(200) % 2
    lost = losses(jax.random.key(1), 0.1, 200)
    delay = exponential_delays(jax.random.key(2), by_sensor(jnp.array([0.0, 2.0]), sensor), 200)
    given = deliver(times, times[:, None], delay, sensor=sensor, lost=lost)
    order = np.asarray(given.order)
    assert sorted(order) == list(range(200))
    assert (np.diff(given.arrival) >= 0).all()
    np.testing.assert_array_equal(given.measurements.time, times[order])
    np.testing.assert_array_equal(given.measurements.value[:, 0], times[order])
    np.testing.assert_array_equal(given.measurements.sensor, sensor[order])
    np.testing.assert_array_equal(given.measurements.mask[:, 0], ~np.asarray(lost)[order])
    np.testing.assert_array_equal(given.arrival, (times + delay)[order])
    np.testing.assert_array_equal(delay[::2], 0)


def test_without_delay_the_order_stays():
    times = regular_times(0.5, 4, start=1.0)
    np.testing.assert_array_equal(times, [1.0, 1.5, 2.0, 2.5])
    for delay in (0.0, fixed_delays(3.0, 4)):
        given = deliver(times, jnp.ones((4, 1)), delay)
        np.testing.assert_array_equal(given.order, np.arange(4))


def test_what_arrives_together_keeps_its_order():
    given = deliver(np.array([0.0, 1.0, 1.0, 0.5]), np.ones((4, 1)), np.array([1.0, 0, 0, 0.5]))
    np.testing.assert_array_equal(given.order, np.arange(4))


def test_the_draws_have_their_distributions():
    count = 40_000
    gaps = np.diff(poisson_times(KEY, 0.2, count))
    waits = np.asarray(exponential_delays(KEY, 5.0, count))
    flat = np.asarray(uniform_delays(KEY, 1.0, 3.0, count))
    np.testing.assert_allclose([gaps.mean(), gaps.std()], 0.2, rtol=0.03)
    np.testing.assert_allclose([waits.mean(), waits.std()], 5.0, rtol=0.03)
    np.testing.assert_allclose([flat.mean(), flat.std()], [2.0, 1 / np.sqrt(3)], rtol=0.02)
    assert flat.min() >= 1.0
    assert flat.max() < 3.0
    np.testing.assert_allclose(np.mean(losses(KEY, 0.3, count)), 0.3, rtol=0.05)


def test_everything_works_under_jit_and_vmap():
    @jax.jit
    @jax.vmap
    def draw(key):
        first, second, third = jax.random.split(key, 3)
        times = poisson_times(first, 1.0, 20)
        delay = exponential_delays(second, 2.0, 20)
        return deliver(times, jnp.zeros((20, 2)), delay, lost=losses(third, 0.2, 20))

    given = draw(jax.random.split(KEY, 3))
    assert given.measurements.value.shape == (3, 20, 2)
    assert (np.diff(given.arrival, axis=1) >= 0).all()


def test_what_is_refused():
    with pytest.raises(ValueError, match="delay: expected a number >= 0"):
        deliver(np.zeros(2), np.zeros((2, 1)), np.array([0.0, -1.0]))
    with pytest.raises(ValueError, match=r"value: expected shape \(T, m\)"):
        deliver(np.zeros(2), np.zeros(2), 0.0)
    with pytest.raises(ValueError, match="mean_interval: expected a positive number"):
        poisson_times(KEY, 0.0, 3)
    with pytest.raises(ValueError, match="high - low: expected a number >= 0"):
        uniform_delays(KEY, 2.0, 1.0, 3)
