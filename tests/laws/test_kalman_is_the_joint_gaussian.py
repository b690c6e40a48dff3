"""The Kalman filter gives the mean, covariance and likelihood of the joint Gaussian, also where Q,
the prior or R are singular or zero."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from oracles.joint_gaussian import log_likelihood, posterior

import ewif_jax as ej
from ewif_jax import Gaussian
from laws.cases import STEPS, case, close, model

FILTER = ej.kalman(model())


def check(world, rtol=1e-9):
    trace = ej.run(FILTER, world.params, world.stream(), prior=world.prior, t0=0.0)
    for k in (0, 4, STEPS - 1):
        mean, cov = posterior(trace.time[k], **world.gaussian(), **world.data(range(k + 1)))
        close(trace.mean[k], mean, rtol)
        close(trace.cov[k], cov, rtol)
    total = log_likelihood(**world.gaussian(), **world.data())
    close(trace.info.log_likelihood.sum(), total, rtol)


@given(st.integers(0, 10_000), st.sampled_from([1, 2, 4]))
def test_random_worlds(seed, n):
    check(case(seed, n))


@pytest.mark.parametrize("rank", [0, 1])
@pytest.mark.parametrize("prior_rank", [0, 1, 4])
def test_singular_process_noise_and_prior(rank, prior_rank):
    world = case(rank + prior_rank, 4, noise_rank=rank)
    root = np.random.default_rng(0).normal(size=(4, prior_rank))
    check(world._replace(prior=Gaussian(world.prior.mean, root @ root.T)))


def test_perfect_measurements():
    """R = 0 on one component: the state is known exactly along it afterwards."""
    world = case(4, 4)
    R = np.stack([np.diag([0.0, 0.7])] * 2)
    check(world._replace(params={**world.params, "R": R}), 1e-8)


def test_reports_predict_with_the_input_and_the_noise():
    world = case(8, 2)
    times = np.maximum.accumulate(world.times) + 0.7
    trace = ej.run(FILTER, world.params, world.stream(), prior=world.prior, t0=0.0, times=times)
    mean, cov = posterior(times[5], **world.gaussian(), **world.data(range(6)))
    close(trace.mean[5], mean)
    close(trace.cov[5], cov)


def test_before_its_own_time_it_reports_nan():
    world = case(8, 2)
    times = np.maximum.accumulate(world.times) - 0.1
    trace = ej.run(FILTER, world.params, world.stream(), prior=world.prior, t0=0.0, times=times)
    assert np.isnan(trace.mean[1:]).all()
