"""On a linear model Jacobians and sigma points of any spread give the Kalman filter."""

from functools import partial

import jax
import numpy as np
import pytest

import ewif_jax as ej
from ewif_jax.estimators.unscented import unscented
from laws.cases import case, close, model

FUNCTIONS = ej.Model(
    model().transition, model().process_cov, model().observe, model().measurement_cov
)


def alpha(params):
    return params["ut_alpha"]


FILTERS = {
    "extended": ej.extended(FUNCTIONS),
    "unscented": unscented(FUNCTIONS, ut_alpha=alpha, ut_beta=2.0, ut_kappa=0.5),
}
KALMAN = ej.kalman(model())
WIDE, NARROW = 1.0, 0.05


@pytest.mark.parametrize("name", FILTERS)
@pytest.mark.parametrize("spread", [WIDE, NARROW])
@pytest.mark.parametrize("noise_rank", [3, 0])
def test_mean_cov_and_diagnostics(name, spread, noise_rank):
    """The masked row, the partial masks and the repeated time of the standard case included."""
    world = case(14, 3, noise_rank)
    options = {"prior": world.prior, "t0": 0.0}
    params = {**world.params, "ut_alpha": spread}
    expected = ej.run(KALMAN, params, world.stream(), **options)
    actual = ej.run(FILTERS[name], params, world.stream(), **options)
    close(actual.mean, expected.mean, 1e-10)
    close(actual.cov, expected.cov, 1e-10)
    for field in ("innovation", "innovation_cov", "log_likelihood", "status"):
        close(getattr(actual.info, field), getattr(expected.info, field), 1e-10)


@pytest.mark.parametrize("name", FILTERS)
def test_a_singular_prior_and_its_gradients(name):
    """A coordinate known exactly, no process noise, and the settings themselves."""
    world = case(14, 3, 0)
    kept = np.array([True, False, True])
    prior = ej.Gaussian(world.prior.mean, world.prior.cov * np.outer(kept, kept))

    def loss(estimator, params):
        trace = ej.run(estimator, params, world.stream(), prior=prior, t0=0.0)
        return (trace.mean**2).sum() + trace.cov.sum() + trace.info.log_likelihood.sum()

    params = {**jax.tree.map(jax.numpy.asarray, world.params), "ut_alpha": 1.0}
    expected, slopes = jax.jit(jax.value_and_grad(partial(loss, KALMAN)))(params)
    value, found = jax.jit(jax.value_and_grad(partial(loss, FILTERS[name])))(params)
    close(value, expected)
    for key in ("rates", "u", "H"):
        close(found[key], slopes[key], 1e-8)
    symmetric = [slope["R"] + slope["R"].swapaxes(1, 2) for slope in (found, slopes)]
    close(*symmetric, 1e-8)
    assert abs(found["ut_alpha"]) < 1e-8 * abs(expected)


@pytest.mark.parametrize("name", ["kalman", *FILTERS])
def test_one_arrival_counts_once(name):
    """The same value twice, at the same time, is one value of half the variance: no more."""
    world = case(3, 3)
    build = {"kalman": KALMAN, **FILTERS}[name]
    params = {**world.params, "ut_alpha": 1.0}
    halved = {**params, "R": params["R"] / 2}
    one = jax.tree.map(lambda x: x[:1], world.stream())
    twice = jax.tree.map(lambda x: x[np.array([0, 0])], world.stream())
    options = {"prior": world.prior, "t0": 0.0}
    expected = ej.run(build, halved, one, **options)
    actual = ej.run(build, params, twice, **options)
    close(actual.mean[-1], expected.mean[-1])
    close(actual.cov[-1], expected.cov[-1])
