"""Over simulated worlds errors are as large as the filters say: NEES and NIS after two steps."""

import jax
import numpy as np
import pytest
from late_streams import problem

import ewif_jax as ej
from ewif_jax.estimators.ensemble import ensemble
from ewif_jax.estimators.unscented import unscented

RUNS, MEMBERS, TIMES = 600, 300, (0.4, 1.1)
PROBLEM = problem(7, 3, 1)
FILTERS = {
    "unscented": unscented(PROBLEM.model),
    "stochastic": ensemble(PROBLEM.model, MEMBERS),
    "square_root": ensemble(PROBLEM.model, MEMBERS, "square_root"),
}


def simulated():
    """True states (RUNS, 2, n) and values (RUNS, 2) of worlds drawn from prior and noise."""
    rng, world = np.random.default_rng(11), PROBLEM.oracle

    def drawn(cov):
        values, vectors = np.linalg.eigh(cov)
        root = vectors * np.sqrt(np.maximum(values, 0))
        return rng.normal(size=(RUNS, len(cov))) @ root.T

    x, now, truth, seen = world["prior_mean"] + drawn(world["prior_cov"]), 0.0, [], []
    for sensor, t in enumerate(TIMES):
        x = x @ world["F"](now, t).T + world["b"](now, t) + drawn(world["Q"](now, t))
        truth.append(x)
        seen.append(x @ PROBLEM.H[sensor].T + drawn(PROBLEM.R[sensor]))
        now = t
    return np.stack(truth, 1), np.stack(seen, 1)


@pytest.mark.parametrize("name", FILTERS)
def test_errors_and_innovations(name):
    truth, values = simulated()
    data = ej.Measurement(
        jax.numpy.asarray(TIMES),
        jax.numpy.asarray(values),
        jax.numpy.arange(2, dtype=jax.numpy.int32),
        jax.numpy.ones((2, 1), bool),
    )
    key = jax.random.key(5)
    trace = ej.run_batch(FILTERS[name], None, data, prior=PROBLEM.prior, t0=0.0, key=key)
    error = np.asarray(trace.mean) - truth
    nees = np.einsum("rti,rtij,rtj->rt", error, np.linalg.inv(trace.cov), error)
    nis = np.asarray(trace.info.innovation[..., 0] ** 2 / trace.info.innovation_cov[..., 0, 0])
    for statistic, freedom in ((nees, 3), (nis, 1)):
        share = 0 if name == "unscented" else 6 / MEMBERS
        standard_error = np.sqrt(2 * freedom / RUNS)
        gap = np.abs(statistic.mean(0) - freedom)
        assert np.all(gap < 4 * standard_error + share * freedom)


def test_runs_have_noise_of_their_own_and_a_batch_is_its_runs():
    data = ej.stream(TIMES, [0.3, -0.2], [0, 1])
    batch = jax.tree.map(lambda x: jax.numpy.stack([x] * 4), data)
    options, key = {"prior": PROBLEM.prior, "t0": 0.0}, jax.random.key(5)
    estimator = ensemble(PROBLEM.model, 10)
    together = ej.run_batch(estimator, None, batch, key=key, **options)
    for k, own in enumerate(jax.random.split(key, 4)):
        alone = ej.run(estimator, None, data, key=own, **options)
        np.testing.assert_allclose(together.mean[k], alone.mean, atol=1e-10)
    assert np.unique(together.mean[:, -1, 0]).size == 4
