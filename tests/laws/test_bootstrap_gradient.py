"""The gradient of the log likelihood: unbiased for the likelihood, in spite of resampling."""

from functools import cache, partial

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


STEPS = 48
RNG = np.random.default_rng(1)
LONG = ej.stream(
    np.arange(1.0, STEPS + 1),
    np.cumsum(RNG.normal(0, 0.5**0.5, STEPS)) + RNG.normal(0, 0.4**0.5, STEPS),
)


@cache
def resampled(particles):
    """Resampled after every measurement; the same filter each time, so it is compiled once."""
    return bootstrap(MODEL, particles, ess_threshold=1.1)


@cache
def slopes(method, steps, keys):
    """Derivatives by q and r of the log likelihood of the first 1, 2, ..., `steps` measurements,
    each (steps,), of every one of (keys,) runs."""
    data = jax.tree.map(lambda x: x[:steps], LONG)

    def so_far(params, key):
        trace = ej.run(method, params, data, prior=PRIOR, t0=0.0, key=key)
        return jnp.cumsum(trace.info.log_likelihood)

    of_one = jax.jacfwd(so_far)
    if keys is None:
        return jax.jit(of_one)(PARAMS, None)
    found = jax.jit(jax.vmap(of_one, (None, 0)))(PARAMS, jax.random.split(jax.random.key(2), keys))
    return jax.tree.map(np.asarray, found)


def log_likelihood(params, method, key=None):
    trace = ej.run(method, params, DATA, prior=PRIOR, t0=0.0, key=key)
    return jnp.sum(trace.info.log_likelihood)


@pytest.mark.parametrize("threshold", [0.5, 1.1])
def test_on_average_it_is_the_kalman_filters(threshold):
    """The derivative of the likelihood estimate exactly, that of its logarithm up to 1 / N."""
    of_kalman = jax.value_and_grad(partial(log_likelihood, method=ej.kalman(MODEL)))
    value, expected = jax.jit(of_kalman)(PARAMS)
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


@pytest.mark.parametrize("name", PARAMS)
def test_its_variance_grows_faster_than_the_square_of_the_number_of_steps(name):
    """Between 12 and 48 of them, by more than the scatter of 1000 runs."""
    found = slopes(resampled(100), STEPS, 1000)[name][:, [11, 47]]
    square = np.square(found - found.mean(0))
    scatter = square / square.mean(0)
    error = (scatter[:, 1] - scatter[:, 0]).std() / np.sqrt(1000) / np.log(4)
    power = np.log(square[:, 1].mean() / square[:, 0].mean()) / np.log(4)
    assert 2 + error < power < 4


@pytest.mark.slow
def test_its_bias_is_of_order_one_over_the_number_of_particles():
    """Of the derivative by r after 12 steps: four times as much with a quarter of the particles."""
    expected = slopes(ej.kalman(MODEL), 12, None)["r"][-1]
    bias, error, keys = {}, {}, 8000
    for particles in (25, 100):
        found = slopes(resampled(particles), 12, keys)["r"][:, -1]
        bias[particles], error[particles] = found.mean() - expected, found.std() / np.sqrt(keys)
        assert abs(bias[particles]) > 4 * error[particles]
    assert abs(bias[25] - 4 * bias[100]) < 4 * np.hypot(error[25], 4 * error[100])
    assert 2 < bias[25] / bias[100] < 8


def test_without_resampling_it_is_the_finite_difference_with_equal_random_numbers():
    method = bootstrap(MODEL, 200, ess_threshold=0.0)
    key, h = jax.random.key(1), 1e-6
    loss = jax.jit(lambda p: log_likelihood(p, method, key))
    gradient = jax.jit(jax.grad(loss))(PARAMS)
    for name in PARAMS:
        up, down = (loss({**PARAMS, name: PARAMS[name] + s}) for s in (h, -h))
        np.testing.assert_allclose(gradient[name], (up - down) / (2 * h), rtol=1e-6)
