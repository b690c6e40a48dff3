"""Shulami & Sigalov, V-B: without process noise the Kalman filter is the EWIF with tau -> oo."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

import ewif_jax as ej
from laws.cases import case, close, model

EWIF = ej.ewif(model(), lambda p: p["tau"])
KALMAN = ej.kalman(model())


@given(st.integers(0, 10_000))
def test_the_difference_vanishes_like_one_over_tau(seed):
    world = case(seed, 3, noise_rank=0)
    options = {"prior": world.prior, "t0": 0.0}
    exact = ej.run(KALMAN, world.params, world.stream(), **options)

    def error(tau):
        trace = ej.run(EWIF, {**world.params, "tau": tau}, world.stream(), **options)
        return np.abs(trace.mean - exact.mean).max(), trace

    errors = [error(tau)[0] for tau in (1e3, 1e4, 1e5)]
    np.testing.assert_allclose(errors[1] / errors[0], 0.1, rtol=0.05)
    np.testing.assert_allclose(errors[2] / errors[1], 0.1, rtol=0.05)
    trace = error(1e14)[1]
    close(trace.mean, exact.mean)
    close(trace.cov, exact.cov)
    close(trace.info.log_likelihood, exact.info.log_likelihood)
