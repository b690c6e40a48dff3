"""Smoothing back step by step is exact for one late measurement, however many lags old."""

import numpy as np
import pytest
from late_streams import exact, problem, stream

import ewif_jax as ej
from ewif_jax.oosm.rts_reference import rts_reference

CASES = {
    "between": [0.3, 0.7, 1.0, 1.2, 1.9, 0.8, 2.5],
    "on_a_stored_time": [0.3, 0.7, 1.0, 1.2, 1.9, 0.7, 2.5],
    "in_the_newest_interval": [0.3, 0.7, 1.0, 1.2, 1.9, 1.3, 2.5],
    "before_the_first": [0.3, 0.7, 1.0, 1.2, 1.9, 0.1, 2.5],
    "not_late": [0.3, 0.7, 1.0, 1.2, 1.9, 1.9, 2.5],
    "one_late_then_another": [0.3, 0.7, 0.5, 1.2, 1.9, 1.5, 2.5],
}


@pytest.mark.parametrize("noise_rank", [3, 1])
@pytest.mark.parametrize("name", CASES)
def test_it_is_the_joint_posterior(name, noise_rank):
    world = problem(3, 3, 1, noise_rank)
    data = stream(world, np.random.default_rng(0), CASES[name])
    trace = ej.run(rts_reference(world.model, 6), None, data, prior=world.prior, t0=0.0)
    mean, cov = exact(world, data)
    np.testing.assert_allclose(trace.mean, mean, atol=1e-10)
    np.testing.assert_allclose(trace.cov, cov, atol=1e-10)
    assert np.isfinite(trace.info.log_likelihood).all()


def test_one_lag_is_a1_and_older_is_too_late():
    world = problem(5, 3, 1)
    data = stream(world, np.random.default_rng(0), [0.3, 0.7, 0.5, 1.0, 0.8, 0.6])
    options = {"prior": world.prior, "t0": 0.0}
    one = ej.run(rts_reference(world.model, 1), None, data, **options)
    expected = ej.run(ej.a1(world.model), None, data, **options)
    np.testing.assert_allclose(one.mean, expected.mean, atol=1e-10)
    np.testing.assert_allclose(one.cov, expected.cov, atol=1e-10)
    np.testing.assert_allclose(one.info.log_likelihood, expected.info.log_likelihood, atol=1e-10)
    assert one.info.status[-1] == ej.Status.TOO_LATE


def test_the_one_step_solution_is_not_exact_there():
    """Al1 forgets the data inside the lag: what the steps through the history are for."""
    world = problem(3, 3, 1)
    data = stream(world, np.random.default_rng(0), CASES["before_the_first"])
    trace = ej.run(ej.al1(world.model, 6), None, data, prior=world.prior, t0=0.0)
    assert np.abs(trace.mean[5] - exact(world, data)[0][5]).max() > 1e-3
