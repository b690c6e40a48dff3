"""The accumulated state density gives what filtering again gives, late data in any order."""

import jax
import numpy as np
import pytest
from late_streams import chain, exact, problem, stream

import ewif_jax as ej
from ewif_jax.oosm.asd import asd
from ewif_jax.oosm.replay import replay


def shuffled(rng, count):
    """Irregular times that arrive with exponential delays, one of them measured twice."""
    times = np.sort(rng.uniform(0.0, 5.0, count))
    times[count // 2] = times[count // 2 - 1]
    return times[np.argsort(times + rng.exponential(1.5, count))]


@pytest.mark.parametrize(
    ("n", "m", "rank"), [(1, 1, None), (4, 2, 2), pytest.param(6, 2, None, marks=pytest.mark.slow)]
)
def test_asd_and_replay_are_exact(n, m, rank):
    given = problem(n, n, m, rank)
    rng = np.random.default_rng(n)
    data = stream(given, rng, shuffled(rng, 14))
    assert (np.diff(data.time) < 0).sum() >= 3
    means, covs = exact(given, data)
    for method in (asd(given.model, 13), replay(ej.kalman(given.model), 13)):
        trace = ej.run(method, None, data, prior=given.prior, t0=0.0)
        np.testing.assert_allclose(trace.mean, means, atol=1e-8)
        np.testing.assert_allclose(trace.cov, covs, atol=1e-8)
        late = np.asarray(data.time) < np.maximum.accumulate(data.time)
        np.testing.assert_array_equal(
            trace.info.status, np.where(late, ej.Status.LATE_USED, ej.Status.USED)
        )


@pytest.mark.parametrize("affine", [False, True], ids=["orthogonal", "affine"])
@pytest.mark.parametrize(
    ("n", "seed"),
    [(3, 0), (4, 2), *(pytest.param(*case, marks=pytest.mark.slow) for case in ((3, 1), (4, 3)))],
)
def test_asd_is_exact_where_one_noise_drives_a_chain(n, seed, affine):
    """Integrators in axes that mix them, at intervals from 0.02 to 1: the smallest variance of the
    process noise of an interval is far below the rounding of its largest."""
    given = chain(seed, n, affine)
    rng = np.random.default_rng(seed)
    times = np.cumsum(np.exp(rng.uniform(np.log(0.02), 0.0, 14)))
    times[7] = times[6]
    times = times[np.argsort(times + rng.exponential(2.0, 14))]
    data = stream(given, rng, times)
    assert (np.diff(times) < 0).sum() >= 3
    trace = ej.run(asd(given.model, 14), None, data, prior=given.prior, t0=0.0)
    means, covs = exact(given, data)
    np.testing.assert_allclose(trace.mean, means, atol=1e-8)
    np.testing.assert_allclose(trace.cov, covs, atol=1e-8)


def test_asd_is_exact_without_process_noise():
    given = problem(8, 4, 2, 0)
    rng = np.random.default_rng(8)
    data = stream(given, rng, shuffled(rng, 14))
    means, covs = exact(given, data)
    trace = ej.run(asd(given.model, 14), None, data, prior=given.prior, t0=0.0)
    np.testing.assert_allclose(trace.mean, means, atol=1e-8)
    np.testing.assert_allclose(trace.cov, covs, atol=1e-8)


def test_asd_is_exact_for_all_that_it_accepts():
    """With fewer slots than the delays need, the oldest data are refused and the rest is exact."""
    given = problem(2, 2)
    rng = np.random.default_rng(5)
    data = stream(given, rng, shuffled(rng, 20))
    trace = ej.run(asd(given.model, 3), None, data, prior=given.prior, t0=0.0)
    used = np.asarray(trace.info.status) != ej.Status.TOO_LATE
    assert 0 < (~used).sum() < 12
    means, _ = exact(given, jax.tree.map(lambda x: x[used], data))
    np.testing.assert_allclose(trace.mean[used], means, atol=1e-8)


def test_asd_is_exact_with_a_clock():
    """Moving the filter without measurements in between changes nothing."""
    given = problem(4, 2)
    rng = np.random.default_rng(6)
    times = shuffled(rng, 12)
    data = stream(given, rng, times)
    clock = np.maximum.accumulate(times) + np.linspace(0.1, 0.4, 12)
    ticked = ej.run(
        asd(given.model, 12), None, data, prior=given.prior, t0=0.0, times=clock, clock="arrival"
    )
    plain = ej.run(asd(given.model, 12), None, data, prior=given.prior, t0=0.0, times=clock)
    np.testing.assert_allclose(ticked.mean, plain.mean, atol=1e-9)
    np.testing.assert_allclose(ticked.cov, plain.cov, atol=1e-9)


def test_log_likelihoods_add_up_to_the_joint_one():
    given = problem(7, 3, 2)
    rng = np.random.default_rng(7)
    data = stream(given, rng, shuffled(rng, 12))
    in_order = jax.tree.map(lambda x: x[np.argsort(data.time, kind="stable")], data)
    whole = ej.run(ej.kalman(given.model), None, in_order, prior=given.prior, t0=0.0)
    expected = np.sum(whole.info.log_likelihood)
    for method in (asd(given.model, 12), replay(ej.kalman(given.model), 12)):
        trace = ej.run(method, None, data, prior=given.prior, t0=0.0)
        np.testing.assert_allclose(np.sum(trace.info.log_likelihood), expected, rtol=1e-10)
