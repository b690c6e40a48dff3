"""The expected error of a linear filter along a given truth is exact: it reproduces the sine of
section V-C of Shulami & Sigalov to four digits, and Monte Carlo to its standard error."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import ewif_jax as ej
from ewif_jax.models import position_sensor, random_walk

R = 0.5
STATIC = random_walk(sensors=position_sensor(R))
EWIF = ej.ewif(STATIC, lambda p: p)


@cache
def per_sample(dt):
    """The Kalman filter of a scalar that stands still, with process noise p for each sample."""
    model = ej.linear_model(
        np.eye(1), np.eye(1), R * np.eye(1), lambda p: jnp.square(p) * jnp.eye(1), dt=dt
    )
    return ej.information(model)


TABLE = {
    (1.0, 2 * np.pi * 0.1, 0.1, 10.0): (0.3001, 0.3196),
    (1.0, 2 * np.pi * 0.1, 0.1, 20.0): (0.2971, 0.3232),
    (1.0, 1.0, 0.1, 10.0): (0.3641, 0.4140),
    (1.0, 0.7, 0.09, 10.0): (0.3097, 0.3309),
}
FIRST = next(iter(TABLE))


def sine(amplitude, omega, dt, length):
    times = dt * np.arange(int(length / dt + 1e-9) + 1)
    return times, amplitude * np.sin(omega * times)


def root_mean(estimator, params, times, signal):
    stream = ej.stream(times, signal)
    mse = ej.expected_mse(
        estimator, params, stream, signal[:, None], noise_cov=R, prior=None, t0=0.0
    )
    return float(np.sqrt(np.mean(mse)))


@pytest.mark.parametrize("setting", TABLE)
def test_the_sine_of_section_v_c(setting):
    times, signal = sine(*setting)
    ewif, kalman = TABLE[setting]
    assert round(root_mean(EWIF, 0.5, times, signal), 4) == ewif
    assert round(root_mean(per_sample(setting[2]), 0.1, times, signal), 4) == kalman


def test_it_is_what_sampling_gives():
    runs = 4000
    times, signal = sine(*FIRST)
    values = signal + np.sqrt(R) * np.random.default_rng(0).normal(size=(runs, times.size))
    stream = ej.stream(times, signal)

    def mean(value):
        shifted = stream._replace(value=value[:, None])
        return ej.run(EWIF, 0.5, shifted, prior=None, t0=0.0).mean[:, 0]

    errors = np.mean((np.asarray(jax.jit(jax.vmap(mean))(values)) - signal) ** 2, axis=1)
    expected = root_mean(EWIF, 0.5, times, signal) ** 2
    assert abs(errors.mean() - expected) < 4 * errors.std() / np.sqrt(runs)


def test_its_minimum_is_the_published_one():
    """tau* = 0.4668 s with 0.29964: the gradient in tau vanishes there."""
    times, signal = sine(*FIRST)
    stream = ej.stream(times, signal)

    def loss(tau):
        mse = ej.expected_mse(EWIF, tau, stream, signal[:, None], noise_cov=R, prior=None, t0=0.0)
        return jnp.sqrt(jnp.mean(mse))

    assert round(float(loss(0.4668)), 5) == 0.29964
    slope = jax.jit(jax.grad(loss))
    assert slope(0.4660) < 0 < slope(0.4676)
