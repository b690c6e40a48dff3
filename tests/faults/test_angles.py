"""Angles far from their prediction: one innovation is wrapped, members and particles are not."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import ewif_jax as ej
from ewif_jax.models import wrap_angle

NOISE, COUNT = 1e-4, 4000
MODEL = ej.models.random_walk(sensors=ej.models.bearing_sensor(NOISE), q=1.0, dims=2)
PRIOR = ej.Gaussian(np.array([10.0, 0.0]), 9.0 * np.eye(2))
AROUND = ej.Gaussian(np.array([0.5, 0.0]), np.eye(2))
"""Particles on all sides of the sensor."""


def wrapped(angle):
    return np.pi - (np.pi - angle) % (2 * np.pi)


def measured(time, value, dtype=np.float64):
    value = jnp.asarray([value], dtype)
    return ej.Measurement(jnp.asarray(time, dtype), value, jnp.int32(0), jnp.ones(1, bool))


def moments(x):
    """Predicted bearings of x (2, N), counted from the one at their mean, and innovation of z."""
    origin = np.arctan2(*x.mean(1)[::-1])
    apart = wrapped(np.arctan2(x[1], x[0]) - origin)
    return apart - apart.mean(), origin + apart.mean()


ENSEMBLES = {
    "stochastic": ej.ensemble(MODEL, COUNT),
    "square_root": ej.ensemble(MODEL, COUNT, form="square_root"),
    "enkf1": ej.enkf1(MODEL, COUNT, 3),
    "enkf2": ej.enkf2(MODEL, COUNT, 3, "shared"),
}


@pytest.mark.parametrize("name", ENSEMBLES)
@pytest.mark.parametrize("late", [False, True])
def test_an_ensemble_moves_as_one(name, late):
    """Mean x + K nu and covariance P - K S K', by NumPy from the members' own moments. A late
    measurement has seen the members at the prior, which is where they have been moved from."""
    if late and not name.startswith("enkf"):
        pytest.skip("late measurements are not used")
    method = ENSEMBLES[name]
    update = jax.jit(lambda state, z: method.update(None, state, z))
    state = before = method.init(None, PRIOR, 0.0, jax.random.key(0))
    if late:
        state, _ = update(state, measured(0.0, 0.2))
        state = before = method.predict(None, state, jnp.asarray(1e-10))
    x = np.asarray(before.members)
    e, predicted = moments(x)
    S = e @ e / (COUNT - 1) + NOISE
    K = (x - x.mean(1, keepdims=True)) @ e / (COUNT - 1) / S
    for z in (0.1, 3.0, -2.5):
        after, info = update(state, measured(0.0, z))
        nu = wrapped(z - predicted)
        y = np.asarray(after.members)
        spread = np.trace(np.cov(x) - np.outer(K, K) * S)
        tolerance = 1e-3 if late else 1e-9
        np.testing.assert_allclose(info.innovation[0], nu, rtol=0, atol=tolerance)
        np.testing.assert_allclose(y.mean(1), x.mean(1) + K * nu, rtol=0, atol=10 * tolerance)
        assert abs(np.trace(np.cov(y)) / spread - 1) < 0.05


PARTICLES = {
    "bootstrap": ej.bootstrap(MODEL, COUNT),
    "pf_fixed_point_eks": ej.pf_fixed_point(MODEL, COUNT, 2),
    "pf_fixed_point_ps": ej.pf_fixed_point(MODEL, COUNT, 2, "ps"),
}


@pytest.mark.parametrize("prior", [PRIOR, AROUND])
def test_the_innovation_given_all_particles_is_wrapped_once(prior):
    method = PARTICLES["bootstrap"]
    state = method.init(None, prior, 0.0, jax.random.key(1))
    e, predicted = moments(np.asarray(state.particles))
    for z in (0.1, 3.0, -3.1):
        info = jax.jit(method.update)(None, state, measured(0.0, z))[1]
        np.testing.assert_allclose(info.innovation[0], wrapped(z - predicted), atol=1e-9)
        np.testing.assert_allclose(info.innovation_cov[0, 0], e @ e / COUNT + NOISE, rtol=1e-9)


@pytest.mark.parametrize("name", ["pf_fixed_point_eks", "pf_fixed_point_ps"])
def test_so_it_is_through_the_smoothers(name):
    """Seen a moment ago, from where little has changed: the moments are those of now."""
    method = PARTICLES[name]
    state = method.init(None, PRIOR, 0.0, jax.random.key(1))
    state = method.predict(None, state, jnp.asarray(1e-4))
    e, predicted = moments(np.asarray(state.particles))
    for z in (0.1, 3.0):
        info = jax.jit(method.update)(None, state, measured(0.0, z))[1]
        off = wrapped(float(info.innovation[0]) - wrapped(z - predicted))
        assert abs(off) < 0.03
        np.testing.assert_allclose(info.innovation_cov[0, 0], e @ e / COUNT + NOISE, rtol=0.15)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_an_angle_within_half_a_turn_stays_what_it_is(dtype):
    small = np.array([0.0, 1e-12, -1e-9, 3e-5, -0.7, 3.1, -3.1], dtype)
    np.testing.assert_array_equal(wrap_angle(jnp.asarray(small)), small)
    ends = jnp.asarray([np.pi, -np.pi, 3.5, -9.0, 100.0], dtype)
    right = np.pi - (np.pi - np.asarray(ends, np.float64)) % (2 * np.pi)
    found = np.asarray(wrap_angle(ends), np.float64)
    turns = np.exp(1j * found) - np.exp(1j * right)
    np.testing.assert_allclose(np.abs(turns), 0, atol=100 * np.finfo(dtype).eps)
    assert np.abs(found).max() <= np.pi * (1 + np.finfo(dtype).eps)
    assert float(wrap_angle(jnp.asarray(-np.pi, dtype))) > 0
