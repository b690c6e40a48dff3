"""A1, and Al1 at one lag, give the exact posterior with one late measurement per interval."""

import numpy as np
import pytest
from late_streams import exact, problem, stream

import ewif_jax as ej
from ewif_jax.oosm.a1 import a1
from ewif_jax.oosm.al1 import al1
from ewif_jax.oosm.b1 import b1
from ewif_jax.oosm.bl1 import bl1


def one_late_per_interval(rng, count):
    """Each time but the first is followed by one from the interval before it."""
    grid = np.cumsum(rng.uniform(0.2, 1.0, count))
    late = grid[:-1] + rng.uniform(0.0, 1.0, count - 1) * np.diff(grid)
    late[1] = grid[1]
    return np.concatenate([grid[:1], np.stack([grid[1:], late], 1).ravel()])


@pytest.mark.parametrize(
    ("n", "m", "rank"),
    [(1, 1, None), (3, 2, 1), (4, 1, None), pytest.param(6, 2, None, marks=pytest.mark.slow)],
)
def test_a1_and_al1_are_exact(n, m, rank):
    given = problem(10 + n, n, m, rank)
    rng = np.random.default_rng(n)
    data = stream(given, rng, one_late_per_interval(rng, 6))
    means, covs = exact(given, data)
    for method in (a1(given.model), al1(given.model, 4)):
        trace = ej.run(method, None, data, prior=given.prior, t0=0.0)
        np.testing.assert_allclose(trace.mean, means, atol=1e-8)
        np.testing.assert_allclose(trace.cov, covs, atol=1e-8)


def test_the_log_likelihood_is_that_of_the_late_value_given_the_rest():
    given = problem(3, 2, 2)
    rng = np.random.default_rng(3)
    data = stream(given, rng, one_late_per_interval(rng, 4))
    trace = ej.run(a1(given.model), None, data, prior=given.prior, t0=0.0)
    in_order = np.argsort(data.time, kind="stable")
    whole = ej.run(
        ej.kalman(given.model),
        None,
        ej.Measurement(*(x[in_order] for x in data)),
        prior=given.prior,
        t0=0.0,
    )
    np.testing.assert_allclose(
        trace.info.log_likelihood.sum(), whole.info.log_likelihood.sum(), rtol=1e-10
    )


def test_a_nonlinear_model_that_happens_to_be_linear_gives_the_same():
    given = problem(5, 3, 2)
    rng = np.random.default_rng(5)
    data = stream(given, rng, one_late_per_interval(rng, 5))
    disguised = given.model._replace(linear=None)
    for method in (a1, b1):
        one, two = (
            ej.run(method(model), None, data, prior=given.prior, t0=0.0)
            for model in (given.model, disguised)
        )
        np.testing.assert_allclose(one.mean, two.mean, atol=1e-11)
        np.testing.assert_allclose(one.cov, two.cov, atol=1e-11)


def test_nothing_is_inverted_that_may_be_singular():
    """No process noise, a certain prior, more states than numbers measured inside the lag."""
    still = ej.linear_model(F=lambda p, t0, t1: np.eye(3), H=np.eye(1, 3), R=np.eye(1))
    data = ej.stream(np.array([1.0, 2.0, 1.5, 1.0, 0.0]), np.arange(5.0))
    certain = ej.Gaussian(np.zeros(3), np.zeros((3, 3)))
    for method in (a1(still), b1(still), al1(still, 3), bl1(still, 3)):
        trace = ej.run(method, None, data, prior=certain, t0=0.0)
        np.testing.assert_array_equal(trace.mean, 0)
        np.testing.assert_array_equal(trace.cov, 0)


def test_without_process_noise_every_lag_is_exact():
    given = problem(6, 2)
    model = given.model._replace(process_cov=lambda p, t0, t1: np.zeros((2, 2)))
    given = given._replace(
        model=model, oracle=given.oracle | {"Q": lambda t0, t1: np.zeros((2, 2))}
    )
    rng = np.random.default_rng(6)
    data = stream(given, rng, rng.uniform(0.0, 4.0, 10))
    means, covs = exact(given, data)
    trace = ej.run(al1(model, 10), None, data, prior=given.prior, t0=0.0)
    np.testing.assert_allclose(trace.mean, means, atol=1e-9)
    np.testing.assert_allclose(trace.cov, covs, atol=1e-9)
