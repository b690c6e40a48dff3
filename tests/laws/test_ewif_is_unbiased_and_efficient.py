"""Shulami & Sigalov, Theorem 6: the EWIF is unbiased, and under the artificial model (6), where the
noise itself is scaled by 1/W, its P is the covariance of the error (ERRATA 6)."""

import jax
import numpy as np
import pytest

import ewif_jax as ej
from laws.cases import STEPS, case, model

RUNS = 2000
FILTER = ej.ewif(model(), lambda p: p["tau"])


@pytest.fixture(scope="module")
def errors():
    """Errors at the last time with the noise of model (3) and of model (6), and the reported P."""
    world = case(21, 3)
    rng = np.random.default_rng(5)
    params, now = world.params, world.times[-1]
    x = world.prior.mean
    H, R = params["H"][world.sensors], params["R"][world.sensors]
    truth = np.array([world.F(now, t) @ x + world.b(now, t) for t in world.times])
    white = rng.normal(size=(RUNS, STEPS, 2))
    noise = np.einsum("kij,rkj->rki", np.linalg.cholesky(R), white)
    weight = np.exp(-(now - world.times) / (2 * params["tau"]))

    def last(value):
        stream = world.stream()._replace(value=value)
        trace = ej.run(FILTER, params, stream, prior=None, t0=0.0)
        return trace.mean[-1], trace.cov[-1]

    signal = np.einsum("kij,kj->ki", H, truth)
    both = np.concatenate([signal + noise, signal + noise / weight[:, None]])
    means, covs = jax.jit(jax.vmap(last))(both)
    return np.asarray(means[:RUNS]) - x, np.asarray(means[RUNS:]) - x, np.asarray(covs[0])


@pytest.mark.parametrize("artificial", [False, True])
def test_unbiased_under_both_models(errors, artificial):
    error = errors[artificial]
    standard_error = error.std(0) / np.sqrt(RUNS)
    assert np.all(np.abs(error.mean(0)) < 4 * standard_error)


def test_efficient_under_the_artificial_model_only(errors):
    true_model, artificial, P = errors

    def mean_nees(error):
        return np.einsum("ri,ij,rj->r", error, np.linalg.inv(P), error).mean()

    n = P.shape[0]
    band = 4 * np.sqrt(2 * n / RUNS)
    assert abs(mean_nees(artificial) - n) < band
    assert mean_nees(true_model) < n - band
