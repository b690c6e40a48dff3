"""On linear models ensembles tend to their limit at rate 1 / sqrt(N), late measurements included.

The limit of `ensemble` is the Kalman filter; that of `enkf1` and `enkf2` is what the same steps do
to Gaussians (an oracle), which is not the exact posterior but is close to it one interval back.
"""

from functools import cache

import jax
import numpy as np
import pytest
from late_streams import exact, problem, stream
from oracles.enkf import enkf_limit

import ewif_jax as ej
from ewif_jax.estimators.ensemble import ensemble
from ewif_jax.oosm.enkf1 import enkf1
from ewif_jax.oosm.enkf2 import enkf2
from ewif_jax.recursions.ensembles import fuse_ensembles

LAG, RUNS = 3, 64
PROBLEM = problem(3, 3, 1)
IN_TIME = [0.3, 0.7, 1.0, 1.2, 1.9, 2.0]
LATE = [0.3, 0.7, 1.0, 0.8, 1.2, 1.9, 1.5, 0.75, 2.0]
FILTERS = {
    "stochastic": (lambda count: ensemble(PROBLEM.model, count), IN_TIME, None),
    "square_root": (lambda count: ensemble(PROBLEM.model, count, "square_root"), IN_TIME, None),
    "enkf1": (lambda count: enkf1(PROBLEM.model, count, LAG), LATE, None),
    "enkf2": (lambda count: enkf2(PROBLEM.model, count, LAG), LATE, "fresh"),
    "enkf2_shared": (lambda count: enkf2(PROBLEM.model, count, LAG, "shared"), LATE, "shared"),
}
each = pytest.mark.parametrize("name", FILTERS)


@cache
def built(name, count):
    return FILTERS[name][0](count)


def limit(data, back):
    sensors = np.asarray(data.sensor)
    return enkf_limit(
        **PROBLEM.oracle,
        times=np.asarray(data.time),
        H=PROBLEM.H[sensors],
        R=PROBLEM.R[sensors],
        values=np.asarray(data.value),
        lag=LAG,
        back=back,
    )


@cache
def errors(name, members):
    """Errors of means (RUNS, T, n) and of covariances, in standard deviations of the limit."""
    _, times, back = FILTERS[name]
    data, estimator = stream(PROBLEM, np.random.default_rng(0), times), built(name, members)

    def shown(key):
        trace = ej.run(estimator, None, data, prior=PROBLEM.prior, t0=0.0, key=key)
        return trace.mean, trace.cov

    batch = jax.jit(jax.vmap(shown))
    means, covs = map(np.asarray, batch(jax.random.split(jax.random.key(members), RUNS)))
    mean, cov = limit(data, back)
    sd = np.sqrt(np.diagonal(cov, axis1=1, axis2=2))
    return (means - mean) / sd, (covs - cov) / (sd[:, :, None] * sd[:, None, :])


@each
def test_the_limit_and_the_rate(name):
    """16 times the members, a quarter of the error; what is left has no bias beyond 1 / N."""
    few, many = errors(name, 48), errors(name, 768)
    for rough, fine in zip(few, many, strict=True):
        ratio = np.sqrt(np.mean(rough**2) / np.mean(fine**2))
        assert 3.2 < ratio < 5.0
        standard_error = fine.std(0) / np.sqrt(RUNS)
        assert np.all(np.abs(fine.mean(0)) < 4.5 * standard_error + 3.0 / 768)


def test_the_limit_in_sequence_is_the_exact_posterior():
    data = stream(PROBLEM, np.random.default_rng(0), IN_TIME)
    for found, expected in zip(limit(data, None), exact(PROBLEM, data), strict=True):
        np.testing.assert_allclose(found, expected, atol=1e-10)


def test_a_step_back_with_shared_noise_is_exact_at_a_stored_time_without_anything_since():
    """Nothing has been learned since and nothing is interpolated: the limit is the posterior."""
    data = stream(PROBLEM, np.random.default_rng(2), [0.3, 0.7, 0.7])
    for back in (None, "shared"):
        found, expected = limit(data, back), exact(PROBLEM, data)
        np.testing.assert_allclose(found[0], expected[0], atol=1e-10)
        np.testing.assert_allclose(found[1], expected[1], atol=1e-10)


@pytest.mark.parametrize("name", ["enkf1", "enkf2", "enkf2_shared"])
def test_at_delay_zero_the_late_filters_are_the_ensemble_filter_member_by_member(name):
    data = stream(PROBLEM, np.random.default_rng(1), [0.0, 0.3, 0.3, 0.7, 1.0, 1.2])
    options = {"prior": PROBLEM.prior, "t0": 0.0, "key": jax.random.key(2)}
    late = ej.run(built(name, 6), None, data, **options)
    plain = ej.run(built("stochastic", 6), None, data, **options)
    members = late.final_state.members
    np.testing.assert_allclose(members, plain.final_state.members, atol=1e-11)
    np.testing.assert_allclose(late.info.log_likelihood, plain.info.log_likelihood, atol=1e-11)


@pytest.mark.parametrize("form", ["stochastic", "square_root"])
def test_one_arrival_counts_once(form):
    """The covariance after k equal measurements is that of k, to the sampling error of one draw."""
    world = ej.models.random_walk(sensors=ej.models.position_sensor(1.0))
    prior, data = ej.Gaussian(np.zeros(1), np.eye(1)), ej.stream(np.zeros(4), np.full(4, 0.6))
    count = 20_000
    filtered = ensemble(world, count, form)
    trace = ej.run(filtered, None, data, prior=prior, t0=0.0, key=jax.random.key(3))
    expected = 1 / np.arange(2.0, 6.0)
    np.testing.assert_allclose(trace.cov[:, 0, 0], expected, rtol=5 * np.sqrt(2 / count))
    np.testing.assert_allclose(trace.mean[:, 0], 0.6 * (1 - expected), atol=5 / np.sqrt(count))


def test_fused_ensembles_are_the_best_combination_of_correlated_estimates():
    """Two filters, one sensor each, from one key; Bar-Shalom & Campo with the cross-covariance."""
    members, times = 20_000, [0.3, 0.7, 1.0]
    rng, oracle = np.random.default_rng(5), PROBLEM.oracle
    values, filtered = rng.normal(size=(2, 3)), ensemble(PROBLEM.model, members)
    states = []
    for sensor in (0, 1):
        data = ej.stream(times, values[sensor], sensor)
        trace = ej.run(filtered, None, data, prior=PROBLEM.prior, t0=0.0, key=jax.random.key(1))
        states.append(trace.final_state.members)
    means, P = [np.asarray(oracle["prior_mean"])] * 2, np.tile(oracle["prior_cov"], (2, 2))
    now, n = 0.0, 3
    for k, t in enumerate(times):
        F = np.kron(np.eye(2), oracle["F"](now, t))
        P = F @ P @ F.T + np.tile(oracle["Q"](now, t), (2, 2))
        step = np.zeros((2 * n, 2 * n))
        R = np.zeros((2 * n, 2 * n))
        for s in (0, 1):
            own = slice(s * n, (s + 1) * n)
            H = PROBLEM.H[s]
            K = P[own, own] @ H.T @ np.linalg.inv(H @ P[own, own] @ H.T + PROBLEM.R[s])
            x = oracle["F"](now, t) @ means[s] + oracle["b"](now, t)
            means[s] = x + K @ (values[s, k : k + 1] - H @ x)
            step[own, own], R[own, own] = np.eye(n) - K @ H, K @ PROBLEM.R[s] @ K.T
        P, now = step @ P @ step.T + R, t
    D = np.hstack([np.eye(n), -np.eye(n)])
    K = P[:n] @ D.T @ np.linalg.inv(D @ P @ D.T)
    mean, cov = means[0] - K @ (means[0] - means[1]), P[:n, :n] - K @ D @ P[:, :n]
    fused = np.asarray(fuse_ensembles(states))
    sd = np.sqrt(np.diag(cov))
    assert np.abs((fused.mean(1) - mean) / sd).max() < 0.05
    assert np.abs((np.cov(fused) - cov) / np.outer(sd, sd)).max() < 0.05
    assert np.all(np.diag(cov) < 0.999 * np.minimum(np.diag(P)[:n], np.diag(P)[n:]))


def test_fusing_is_a_tree_of_pairs_and_leaves_equals_alone():
    rng = np.random.default_rng(0)
    a, b, c = rng.normal(size=(3, 2, 50))
    np.testing.assert_allclose(fuse_ensembles([a]), a)
    np.testing.assert_allclose(fuse_ensembles([a, a, a]), a)
    np.testing.assert_allclose(
        fuse_ensembles([a, b, c]), fuse_ensembles([fuse_ensembles([a, b]), c])
    )
    with pytest.raises(ValueError, match=r"ensembles\[1\]: expected shape"):
        fuse_ensembles([a, b[:, :3]])
    with pytest.raises(ValueError, match="ensembles: expected at least one"):
        fuse_ensembles([])
