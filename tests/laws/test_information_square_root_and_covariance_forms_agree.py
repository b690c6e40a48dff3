"""One filter in three forms, also where Q is singular or zero and components are masked."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from oracles.joint_gaussian import posterior

import ewif_jax as ej
from laws.cases import case, close, model

COVARIANCE = ej.kalman(model())
FORMS = {"information": ej.information(model()), "square_root": ej.square_root(model())}


@pytest.mark.parametrize("form", FORMS)
@given(seed=st.integers(0, 10_000), n=st.sampled_from([1, 4]), rank=st.sampled_from([0, 1, None]))
def test_the_same_estimates_and_diagnostics(form, seed, n, rank):
    world = case(seed, n, rank)
    options = {"prior": world.prior, "t0": 0.0}
    expected = ej.run(COVARIANCE, world.params, world.stream(), **options)
    actual = ej.run(FORMS[form], world.params, world.stream(), **options)
    for name in ("time", "mean", "cov"):
        close(getattr(actual, name), getattr(expected, name))
    for name in ("innovation", "innovation_cov", "log_likelihood", "delay", "status"):
        close(getattr(actual.info, name), getattr(expected.info, name))


def test_information_without_a_prior_is_the_limit_of_vague_priors():
    world = case(12, 3)
    options = {"t0": 0.0}
    blind = ej.run(FORMS["information"], world.params, world.stream(), prior=None, **options)
    vague = ej.Gaussian(np.zeros(3), 1e7 * np.eye(3))
    nearly = ej.run(COVARIANCE, world.params, world.stream(), prior=vague, **options)
    close(nearly.mean[4:], blind.mean[4:], 1e-5)
    close(nearly.cov[4:], blind.cov[4:], 1e-5)


def test_information_without_a_prior_is_the_joint_gaussian_with_a_flat_one():
    world = case(13, 2)
    flat = world._replace(prior=ej.Gaussian(np.zeros(2), 1e9 * np.eye(2)))
    trace = ej.run(FORMS["information"], world.params, world.stream(), prior=None, t0=0.0)
    mean, cov = posterior(world.times[-1], **flat.gaussian(), **flat.data())
    close(trace.mean[-1], mean, 1e-5)
    close(trace.cov[-1], cov, 1e-5)
