"""Shulami & Sigalov, Lemma 1: the scale of R moves the covariance, never the estimate.

It holds without a prior, or with a prior scaled along (ERRATA 9).
"""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

import ewif_jax as ej
from ewif_jax import Gaussian
from laws.cases import case, close, model

FILTER = ej.ewif(model(), lambda p: p["tau"])


@given(st.integers(0, 10_000), st.floats(-4.0, 4.0))
def test_scaling_R(seed, exponent):
    world, scale = case(seed, 3), 10.0**exponent
    scaled = {**world.params, "R": scale * world.params["R"]}

    def run(params, prior):
        return ej.run(FILTER, params, world.stream(), prior=prior, t0=0.0)

    one, other = run(world.params, None), run(scaled, None)
    close(other.mean[3:], one.mean[3:])
    close(other.cov[3:], scale * one.cov[3:])
    one = run(world.params, world.prior)
    along = run(scaled, Gaussian(world.prior.mean, scale * world.prior.cov))
    close(along.mean, one.mean)
    close(along.cov, scale * one.cov)


def test_a_prior_that_is_not_scaled_along_breaks_it():
    world = case(0, 3)
    scaled = {**world.params, "R": 100.0 * world.params["R"]}
    means = [
        ej.run(FILTER, params, world.stream(), prior=world.prior, t0=0.0).mean[-1]
        for params in (world.params, scaled)
    ]
    assert np.abs(means[0] - means[1]).max() > 0.01
