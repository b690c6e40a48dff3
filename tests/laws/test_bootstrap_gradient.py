"""The gradient of the log likelihood: unbiased for the likelihood, in spite of resampling."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from particle_runs import deviation

import ewif_jax as ej
from ewif_jax.estimators.bootstrap import bootstrap
from ewif_jax.models import position_sensor, random_walk

MODEL = random_walk(sensors=position_sensor(lambda p: p["r"]), q=lambda p: p["q"])
PARAMS = {"q": jnp.asarray(0.5), "r": jnp.asarray(0.4)}
PRIOR = ej.Gaussian(np.zeros(1), np.eye(1))
VALUES = np.array([0.3, -0.4, 0.6, 0.9, 0.2, -0.1])
DATA = ej.stream(np.arange(1.0, 7.0), VALUES)


def log_likelihood(params, method, key=None):
    trace = ej.run(method, params, DATA, prior=PRIOR, t0=0.0, key=key)
    return jnp.sum(trace.info.log_likelihood)


@pytest.mark.parametrize("threshold", [0.5, 1.1])
def test_on_average_it_is_the_kalman_filters(threshold):
    """The derivative of the likelihood estimate exactly, that of its logarithm up to 1 / N."""
    value, expected = jax.value_and_grad(log_likelihood)(PARAMS, ej.kalman(MODEL))
    method = bootstrap(MODEL, 400, ess_threshold=threshold)
    both = jax.value_and_grad(lambda p, key: log_likelihood(p, method, key))
    keys = jax.random.split(jax.random.key(3), 600)
    values, gradients = jax.jit(lambda keys: jax.lax.map(lambda k: both(PARAMS, k), keys))(keys)
    ratio = np.exp(np.asarray(values) - float(value))
    assert deviation(ratio, 1.0) < 4
    for name in PARAMS:
        found = np.asarray(gradients[name])
        assert deviation(ratio * found, float(expected[name])) < 4
        assert abs(found.mean() - expected[name]) < 4 * found.std() / np.sqrt(600) + 10 / 400
        assert found.std() < 1.0


def test_without_resampling_it_is_the_finite_difference_with_equal_random_numbers():
    method = bootstrap(MODEL, 200, ess_threshold=0.0)
    key, h = jax.random.key(1), 1e-6
    loss = jax.jit(lambda p: log_likelihood(p, method, key))
    gradient = jax.grad(loss)(PARAMS)
    for name in PARAMS:
        up, down = (loss({**PARAMS, name: PARAMS[name] + s}) for s in (h, -h))
        np.testing.assert_allclose(gradient[name], (up - down) / (2 * h), rtol=1e-6)
