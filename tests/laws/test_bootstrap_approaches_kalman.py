"""On a linear Gaussian model the bootstrap filter converges to the Kalman filter."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from late_streams import exact, problem, stream
from oracles.joint_gaussian import log_likelihood, posterior
from particle_runs import deviation, runs

import ewif_jax as ej
from ewif_jax.estimators.bootstrap import bootstrap
from ewif_jax.oosm.drop_late import drop_late
from ewif_jax.oosm.replay import replay

GIVEN = problem(3, 2, 2)
TIMES = np.array([0.4, 0.9, 0.9, 1.7, 2.2])
DATA = stream(GIVEN, np.random.default_rng(1), TIMES)
DATA = DATA._replace(mask=DATA.mask.at[1, 0].set(False), value=DATA.value.at[1, 0].set(0.0))


def oracle():
    """Mean, covariance and log likelihood at the end, the missing component left out."""
    sensors = np.asarray(DATA.sensor)
    data = {
        "times": TIMES,
        "H": GIVEN.H[sensors],
        "R": GIVEN.R[sensors],
        "values": np.asarray(DATA.value),
        "masks": np.asarray(DATA.mask),
    }
    mean, cov = posterior(TIMES[-1], **GIVEN.oracle, **data)
    return mean, cov, log_likelihood(**GIVEN.oracle, **data)


def last(trace):
    return trace.mean[-1], trace.cov[-1], jnp.sum(trace.info.log_likelihood)


@pytest.mark.parametrize("scheme", ["systematic", "stratified"])
def test_estimates_and_likelihood_have_no_visible_bias(scheme):
    mean, cov, log_lik = oracle()
    method = bootstrap(GIVEN.model, 4000, scheme)
    means, covs, log_liks = runs(method, DATA, GIVEN.prior, 40, of=last)
    assert deviation(means, mean) < 4
    assert deviation(covs, cov) < 4
    assert deviation(np.exp(log_liks - log_lik), 1.0) < 4
    assert means.std(0).max() < 0.2 * np.sqrt(np.diag(cov)).min()


def test_the_error_falls_with_the_square_root_of_the_number():
    mean, _, _ = oracle()
    errors = []
    for count in (250, 4000):
        means, _, _ = runs(bootstrap(GIVEN.model, count), DATA, GIVEN.prior, 150, of=last)
        errors.append(np.sqrt(np.mean((means - mean) ** 2)))
    assert 3.2 < errors[0] / errors[1] < 5.0


def test_the_likelihood_is_unbiased_even_with_few_particles():
    _, _, log_lik = oracle()
    *_, log_liks = runs(bootstrap(GIVEN.model, 50), DATA, GIVEN.prior, 4000, of=last)
    assert deviation(np.exp(log_liks - log_lik), 1.0) < 4


def test_replay_uses_late_data_exactly_and_drop_late_does_not():
    late = stream(GIVEN, np.random.default_rng(1), [0.5, 1.0, 1.5, 0.8, 1.8])
    mean, _ = (x[-1] for x in exact(GIVEN, late))
    method = bootstrap(GIVEN.model, 2000)

    def final(trace):
        return trace.mean[-1], trace.info.status

    means, status = runs(replay(method, 4, width=2), late, GIVEN.prior, 20, of=final)
    assert deviation(means, mean) < 4
    assert (status[:, 3] == ej.Status.LATE_USED).all()
    means, status = runs(drop_late(method), late, GIVEN.prior, 20, of=final)
    kept = jax.tree.map(lambda x: x[np.array([0, 1, 2, 4])], late)
    mean, _ = (x[-1] for x in exact(GIVEN, kept))
    assert deviation(means, mean) < 4
    assert (status[:, 3] == ej.Status.TOO_LATE).all()
