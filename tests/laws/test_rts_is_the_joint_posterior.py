"""The smoother gives the exact Gaussian posterior of a linear model, singular noise included."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles.joint_gaussian import posterior

from ewif_jax.estimator import run
from ewif_jax.estimators.extended import extended
from ewif_jax.estimators.kalman import kalman
from ewif_jax.models import bearing_sensor, constant_velocity
from ewif_jax.smoothers.rts import rts
from ewif_jax.streams import stream
from ewif_jax.types import Gaussian
from laws.cases import STEPS, case, close, model


@pytest.mark.parametrize("noise_rank", [3, 1, 0])
@pytest.mark.parametrize("prior_rank", [3, 1])
def test_any_order_of_irregular_masked_data(noise_rank, prior_rank):
    world = case(4, 3, noise_rank)
    kept = np.arange(3) < prior_rank
    prior = Gaussian(world.prior.mean, world.prior.cov * np.outer(kept, kept))
    world = world._replace(prior=prior)
    order = np.random.default_rng(5).permutation(STEPS)
    smoothed = rts(model(), world.params, world.stream(order), prior=prior, t0=0.0)
    for k, t in enumerate(world.times[order]):
        mean, cov = posterior(t, **world.gaussian(), **world.data())
        close(smoothed.mean[k], mean)
        close(smoothed.cov[k], cov)


def test_last_state_is_the_filters_also_when_nonlinear():
    sensors = [bearing_sensor(1e-3, (-5.0, 0.0)), bearing_sensor(1e-3, (9.0, -3.0))]
    turning = constant_velocity(sensors=sensors, dims=2, q=0.1)
    prior = Gaussian(np.array([3.0, 4.0, 0.5, 0.0]), np.eye(4))
    seen = stream(np.arange(1.0, 9.0), np.linspace(0.5, 0.8, 8), np.arange(8) % 2)
    filtered = run(extended(turning), None, seen, prior=prior, t0=0.0)
    smoothed = rts(turning, None, seen, prior=prior, t0=0.0)
    close(smoothed.mean[-1], filtered.mean[-1], rtol=1e-12)
    close(smoothed.cov[-1], filtered.cov[-1], rtol=1e-12)
    traces = [np.trace(x.cov, axis1=1, axis2=2) for x in (smoothed, filtered)]
    assert np.all(traces[0][:-1] < traces[1][:-1])


def test_is_never_less_certain_than_the_filter():
    world = case(4, 3)
    filtered = run(kalman(model()), world.params, world.stream(), prior=world.prior, t0=0.0)
    smoothed = rts(model(), world.params, world.stream(), prior=world.prior, t0=0.0)
    assert np.linalg.eigvalsh(filtered.cov - smoothed.cov).min() > -1e-12


@pytest.mark.parametrize("scale", [1.0, 0.0])
def test_gradient_is_the_finite_difference(scale):
    world = case(4, 3)

    def loss(scale):
        params = {**jax.tree.map(jnp.asarray, world.params)}
        params["q"] = scale * params["q"]
        smoothed = rts(model(), params, world.stream(), prior=world.prior, t0=0.0)
        return jnp.sum(smoothed.mean**2) + jnp.sum(smoothed.cov)

    step = 1e-5
    # Below q = 0 there is no model: from there on only one side says what the slope is.
    shifts, weights = ((1, -1), (0.5, -0.5)) if scale else ((0, 1, 2), (-1.5, 2.0, -0.5))
    slope = sum(w * loss(scale + k * step) for k, w in zip(shifts, weights, strict=True)) / step
    np.testing.assert_allclose(jax.jit(jax.grad(loss))(scale), slope, rtol=1e-6)


def test_float32_is_close():
    world = case(4, 3)
    single = world.stream()._replace(value=world.stream().value.astype(jnp.float32))
    low = rts(model(), world.params, single, prior=world.prior, t0=0.0)
    high = rts(model(), world.params, world.stream(), prior=world.prior, t0=0.0)
    assert low.mean.dtype == low.cov.dtype == jnp.float32
    close(low.mean, high.mean, rtol=1e-4)
    close(low.cov, high.cov, rtol=1e-4)


def test_bad_input_is_named():
    world = case(4, 3)
    with pytest.raises(ValueError, match=r"measurements\.time"):
        rts(model(), world.params, world.stream(), prior=world.prior, t0=10.0)
    with pytest.raises(ValueError, match="prior"):
        rts(model(), world.params, world.stream(), prior=None, t0=0.0)
