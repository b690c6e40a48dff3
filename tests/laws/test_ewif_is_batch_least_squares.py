"""Shulami & Sigalov, Theorems 2-5: the recursion is the batch estimate (8)-(9), at any time.

With known inputs, two sensors, masks, irregular times, late arrivals, with or without a prior, and
reported before, at and after the time of the state.
"""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from oracles.wls import batch_wls, ewif_weight

import ewif_jax as ej
from laws.cases import STEPS, case, close, model

FILTER = ej.ewif(model(), lambda p: p["tau"])


def batch(world, kept, t, with_prior):
    prior = (world.prior.mean, world.prior.cov, 0.0) if with_prior else None
    return batch_wls(
        t, **world.back(), **world.data(kept), weight=ewif_weight(world.params["tau"]), prior=prior
    )


@pytest.mark.parametrize("with_prior", [True, False])
@given(
    seed=st.integers(0, 10_000),
    n=st.sampled_from([2, 4]),
    order=st.permutations(range(4, STEPS)),
    shift=st.floats(-1.5, 1.5),
)
def test_recursion_is_the_batch_at_any_report_time(with_prior, seed, n, order, shift):
    world = case(seed, n)
    arrivals = [*range(4), *order]
    newest = np.maximum.accumulate(world.times[arrivals])
    times = newest + shift
    trace = ej.run(
        FILTER,
        world.params,
        world.stream(arrivals),
        prior=world.prior if with_prior else None,
        t0=0.0,
        times=times,
    )
    for k in range(4, STEPS):
        mean, cov = batch(world, arrivals[: k + 1], times[k], with_prior)
        close(trace.mean[k], mean, 1e-8)
        close(trace.cov[k], cov, 1e-8)


def test_fixed_lag_theorem_5_is_the_retrodicted_filter():
    """Mean A x + c and covariance exp(-lag / tau) A P A' (ERRATA 2)."""
    world, lag = case(5, 3), 0.8
    options = {"prior": None, "t0": 0.0}
    now = ej.run(FILTER, world.params, world.stream(), **options)
    times = np.asarray(now.time) - lag
    then = ej.run(FILTER, world.params, world.stream(), times=times, **options)
    A, c = world.F(lag, 0.0), world.b(lag, 0.0)
    for k in range(4, STEPS):
        close(then.mean[k], A @ now.mean[k] + c)
        close(then.cov[k], np.exp(-lag / world.params["tau"]) * A @ now.cov[k] @ A.T)


def test_the_estimate_is_nan_until_the_data_determine_the_state():
    world = case(3, 4)
    trace = ej.run(FILTER, world.params, world.stream(), prior=None, t0=0.0)
    assert np.all(np.isnan(trace.mean[0]))
    assert np.all(np.isfinite(trace.mean[2:]))
    np.testing.assert_array_equal(trace.info.log_likelihood[:2], 0.0)
