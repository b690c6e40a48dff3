"""Fixed lag: Kalman's by augmentation is the posterior so far, EWIF's is Theorem 5."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles import wls
from oracles.joint_gaussian import posterior

from ewif_jax.estimator import run
from ewif_jax.estimators.ewif import ewif
from ewif_jax.estimators.kalman import kalman
from ewif_jax.smoothers.fixed_lag import fixed_lag
from ewif_jax.smoothers.fixed_lag_ewif import fixed_lag_ewif
from laws.cases import STEPS, case, close, model

LAG = 2


def tau(params):
    return params["tau"]


def test_kalman_fixed_lag_is_the_posterior_of_the_data_so_far():
    world = case(6, 2, 1)
    trace = run(fixed_lag(model(), LAG), world.params, world.stream(), prior=world.prior, t0=0.0)
    filtered = run(kalman(model()), world.params, world.stream(), prior=world.prior, t0=0.0)
    close(trace.info.log_likelihood, filtered.info.log_likelihood)
    present = world.masks.any(axis=1)
    for k in np.flatnonzero(present):
        so_far = np.arange(STEPS)[: k + 1][present[: k + 1]]
        stamps = np.unique(world.times[so_far])
        behind = stamps[-1 - LAG] if stamps.size > LAG else 0.0
        mean, cov = posterior(behind, **world.gaussian(), **world.data(so_far))
        close(trace.mean[k], mean)
        close(trace.cov[k], cov)
    close(trace.final_state.times, stamps[::-1][: LAG + 1])


def test_kalman_fixed_lag_refuses_late_data():
    world = case(6, 2)
    order = np.arange(STEPS)[::-1]
    smoother = fixed_lag(model(), LAG)
    trace = run(smoother, world.params, world.stream(order), prior=world.prior, t0=0.0)
    stamps, present = world.times[order], world.masks[order].any(axis=1)
    expected = np.where(stamps < stamps[0], 2, 0)
    np.testing.assert_array_equal(trace.info.status, np.where(present, expected, 4))


@pytest.mark.parametrize("lag", [0.0, 0.7])
def test_ewif_fixed_lag_is_batch_least_squares_at_the_lagged_time(lag):
    world = case(6, 2)
    order = np.random.default_rng(7).permutation(STEPS)
    smoother = fixed_lag_ewif(model(), tau, lag=lag)
    trace = run(smoother, world.params, world.stream(order), prior=None, t0=0.0)
    mean, cov = wls.batch_wls(
        world.times.max() - lag,
        **world.back(),
        **world.data(),
        weight=wls.ewif_weight(world.params["tau"]),
    )
    close(trace.mean[-1], mean)
    close(trace.cov[-1], cov)


def test_ewif_fixed_lag_is_reporting_earlier():
    world = case(6, 2)
    arguments = {"prior": world.prior, "t0": 0.0}
    smoother = fixed_lag_ewif(model(), tau, lag=0.5)
    lagged = run(smoother, world.params, world.stream(), **arguments)
    early = run(
        ewif(model(), tau), world.params, world.stream(), times=world.times - 0.5, **arguments
    )
    close(lagged.mean, early.mean, rtol=1e-12)
    close(lagged.cov, early.cov, rtol=1e-12)


def test_gradients_are_finite_differences():
    world = case(6, 2, 1)
    smoother = fixed_lag(model(), LAG)

    def loss(scale):
        params = {**jax.tree.map(jnp.asarray, world.params)}
        params["q"] = scale * params["q"]
        trace = run(smoother, params, world.stream(), prior=world.prior, t0=0.0)
        return jnp.sum(trace.mean**2) + jnp.sum(trace.cov)

    slope = (loss(1 + 1e-5) - loss(1 - 1e-5)) / 2e-5
    np.testing.assert_allclose(jax.jit(jax.grad(loss))(1.0), slope, rtol=1e-7)


def test_bad_lags_are_named():
    with pytest.raises(ValueError, match="lag"):
        fixed_lag(model(), 0)
    with pytest.raises(ValueError, match="lag"):
        fixed_lag_ewif(model(), 1.0, lag=-1)
