"""Al1 and Bl1 at several lags are the appendix of Pornsarayouth & Yamakita, corrected."""

import numpy as np
import pytest
from late_streams import problem, stream
from oracles import late
from oracles.kalman_loop import kalman_filter

import ewif_jax as ej
from ewif_jax.oosm.a1 import a1
from ewif_jax.oosm.al1 import al1
from ewif_jax.oosm.b1 import b1
from ewif_jax.oosm.bl1 import bl1

GRID = np.array([0.4, 0.9, 1.7, 2.0, 2.6, 3.3])


def expected(given, data, rule, delayed):
    """`rule` applied to the late values `delayed` (indices of the stream) after the grid."""
    count = len(GRID)
    sensors, values = np.asarray(data.sensor), np.asarray(data.value)
    track = kalman_filter(
        **given.oracle,
        times=GRID,
        H=given.H[sensors[:count]],
        R=given.R[sensors[:count]],
        values=values[:count],
    )
    motion = {name: given.oracle[name] for name in ("F", "Q", "b")}
    grid = [0.0, *GRID]
    means = [given.oracle["prior_mean"], *track.means]
    covs = [given.oracle["prior_cov"], *track.covs]
    mean, cov = means[-1], covs[-1]
    for k in delayed:
        time = float(data.time[k])
        start = np.searchsorted(grid, time, side="right") - 1
        lag = late.lag_interval(grid[start], means[start], covs[start], time, GRID[-1], **motion)
        mean, cov = rule(mean, cov, lag, given.H[sensors[k]], given.R[sensors[k]], values[k])
    return mean, cov


@pytest.mark.parametrize(("ours", "rule"), [(al1, late.al1), (bl1, late.bl1)])
@pytest.mark.parametrize("n", [1, 4])
def test_several_lags(ours, rule, n):
    given = problem(20 + n, n, 2)
    rng = np.random.default_rng(n)
    data = stream(given, rng, np.concatenate([GRID, [1.2, 2.3, 0.9, 0.1]]))
    trace = ej.run(ours(given.model, 6), None, data, prior=given.prior, t0=0.0)
    for k in range(6, 10):
        mean, cov = expected(given, data, rule, range(6, k + 1))
        np.testing.assert_allclose(trace.mean[k], mean, atol=1e-9)
        np.testing.assert_allclose(trace.cov[k], cov, atol=1e-9)


@pytest.mark.parametrize(("short", "long"), [(a1, al1), (b1, bl1)])
def test_the_one_lag_methods_are_the_multi_lag_ones_at_lag_one(short, long):
    given = problem(31, 3)
    rng = np.random.default_rng(1)
    data = stream(given, rng, np.concatenate([GRID, [2.9, 2.8, 1.0]]))
    one = ej.run(short(given.model), None, data, prior=given.prior, t0=0.0)
    two = ej.run(long(given.model, 1), None, data, prior=given.prior, t0=0.0)
    np.testing.assert_array_equal(one.mean, two.mean)
    np.testing.assert_array_equal(one.cov, two.cov)
    assert list(one.info.status[-3:]) == [1, 1, 2]


def test_late_arrivals_between_two_moves_commute():
    """Al1 is a plain Kalman update for each late value, so their order does not matter."""
    given = problem(32, 4, 2)
    rng = np.random.default_rng(2)
    delayed = np.array([1.2, 2.3, 0.1, 2.4, 3.0])
    data = stream(given, rng, np.concatenate([GRID, delayed, [4.0]]))
    estimator = al1(given.model, 6)
    plain = ej.run(estimator, None, data, prior=given.prior, t0=0.0)
    for seed in range(3):
        order = np.arange(12)
        order[6:11] = np.random.default_rng(seed).permutation(order[6:11])
        moved = ej.Measurement(*(x[order] for x in data))
        trace = ej.run(estimator, None, moved, prior=given.prior, t0=0.0)
        np.testing.assert_allclose(trace.mean[10:], plain.mean[10:], atol=1e-10)
        np.testing.assert_allclose(trace.cov[10:], plain.cov[10:], atol=1e-10)
