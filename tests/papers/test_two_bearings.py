"""Pornsarayouth & Yamakita, sections 5 and 6, at reduced size: each claim as we measure it."""

import jax
import numpy as np
import pytest
from apart import apart

from ewif_jax.study.papers.two_bearings import runs as runs_of
from ewif_jax.study.papers.two_bearings import study
from ewif_jax.study.papers.two_bearings.claims import FIVE, NONE, TEN
from ewif_jax.study.shared.claims import ratio, share
from ewif_jax.study.shared.late import mean_of, rmse_of

REFERENCE = {
    runs_of.EXACT: ((3.57, 0.21), (6.67, 0.26), (10.85, 0.33)),
    runs_of.RTS: ((3.56, 0.20), (6.86, 0.25), (12.04, 0.32)),
    runs_of.EKF: ((3.56, 0.19), (7.50, 0.22), (14.20, 0.43)),
    runs_of.ENKF2: ((3.59, 0.20), (7.54, 0.22), (14.30, 0.34)),
    runs_of.SHARED: ((3.64, 0.24), (6.77, 0.28), (11.50, 0.32)),
}
"""independently computed: RMSE and standard error at the three delays"""
BOUND = (3.38, 6.37, 10.52)
LOST = {runs_of.PF: (0.07, 0.23, 0.60), runs_of.HALF: (0.22, 0.51, 0.79)}
"""independently computed, over 100 runs: shares of lost runs with 10,000 and 5,000 retrodicted
particles"""


def computed(left_out):
    """The times of a world (D, T), what every method finds in it, and its bounds."""
    world = runs_of.bearings_world(jax.random.key(2), 60)
    every = {
        name: x for name, x in runs_of.bearings_methods(10_000).items() if name not in left_out
    }
    found = {
        name: runs_of.followed_bearings(one, world, jax.random.key(5))
        for name, one in every.items()
    }
    return world.times, found, runs_of.bearings_bounds(world)


@pytest.fixture(scope="module")
def results(pytestconfig):
    """Particles, which take longer than all the rest, for the slow tests only."""
    left_out = () if pytestconfig.getoption("--all") else tuple(LOST)
    return apart(computed, left_out, double=False)


@pytest.fixture(scope="module")
def times(results):
    return results[0]


@pytest.fixture(scope="module")
def found(results):
    return results[1]


@pytest.fixture(scope="module")
def bound(results):
    return results[2]


@pytest.fixture(scope="module")
def off(times, found):
    """Mean squared errors (D, R)."""
    return {name: study.squared(one["error"], times) for name, one in found.items()}


@pytest.mark.parametrize("name", REFERENCE)
def test_errors_are_those_of_an_independent_computation(off, name):
    for delay, (value, error) in enumerate(REFERENCE[name]):
        ours = rmse_of(off[name][delay])
        assert abs(ours.value - value) < 4 * np.hypot(ours.error, error)


def test_no_filter_is_below_the_bound_and_exact_replay_reaches_it(times, found, off, bound):
    floor = study.reported(bound["right"], times)
    for delay, value in enumerate(BOUND):
        ours = mean_of(floor[delay])
        assert abs(ours.value - value) < 4 * np.hypot(ours.error, 0.04 * value)
        exact = ratio(off[runs_of.EXACT][delay], study.squared(
            np.sqrt(bound["right"]), times)[delay])  # fmt: skip
        assert abs(exact.value - 1) < 3 * exact.error + 0.05
    sd = study.reported(found[runs_of.EXACT]["variance"], times)
    np.testing.assert_allclose(sd.mean(1), floor.mean(1), rtol=0.05)


def test_the_published_bound_is_not_one(times, found, bound):
    printed = study.reported(bound["published"], times)
    reported = study.reported(found[runs_of.EKF]["variance"], times)
    for delay in (FIVE, TEN):
        assert printed[delay].mean() > 1.5 * reported[delay].mean()


def test_without_a_delay_the_filters_are_alike(off):
    for name in (runs_of.RTS, runs_of.ENKF2, runs_of.SHARED, runs_of.EKF):
        same = ratio(off[name][NONE], off[runs_of.EXACT][NONE])
        assert abs(same.value - 1) < 3 * same.error + 0.03


@pytest.mark.parametrize("delay", [FIVE, TEN])
@pytest.mark.parametrize(
    ("better", "worse"),
    [
        (runs_of.ENKF2, runs_of.ENKF1),
        (runs_of.EKF, runs_of.ENKF1),
        (runs_of.RTS, runs_of.EKF),
        (runs_of.SHARED, runs_of.ENKF2),
        (runs_of.SHARED, runs_of.EKF),
        (runs_of.EXACT, runs_of.RTS),
    ],
)
def test_order_of_the_filters(found, off, better, worse, delay):
    """In the runs that neither loses."""
    kept = ~np.any([study.lost(found[name]["error"])[delay] for name in (better, worse)], 0)
    gain = ratio(off[better][delay][kept], off[worse][delay][kept])
    assert gain.value + 2 * gain.error < 1


def test_enkf1_is_twice_as_far_off_as_enkf2(off):
    """In the median: single runs of EnKF1 diverge. Independently computed: 2.2 to 2.3."""
    for delay in (FIVE, TEN):
        middle = [np.sqrt(np.median(off[name][delay])) for name in (runs_of.ENKF1, runs_of.ENKF2)]
        assert 1.6 < middle[0] / middle[1] < 3.0


def test_dropping_what_is_late_loses_the_target(found):
    gone = study.lost(found[runs_of.DROP]["error"])
    assert share(gone[NONE]).value == 0
    assert share(gone[FIVE]).value > 0.7
    assert share(gone[TEN]).value > 0.7
    for name in (runs_of.EKF, runs_of.RTS, runs_of.SHARED, runs_of.EXACT):
        assert study.lost(found[name]["error"])[: FIVE + 1].mean() < 0.02


@pytest.mark.slow
@pytest.mark.parametrize("name", LOST)
def test_retrodicted_particles_get_lost_the_more_the_longer_the_delay(found, name):
    gone = study.lost(found[name]["error"])
    for delay, expected in enumerate(LOST[name]):
        ours, theirs = share(gone[delay]), np.sqrt(expected * (1 - expected) / 100)
        assert abs(ours.value - expected) < 4 * np.hypot(ours.error, theirs)
    more = mean_of(gone[TEN].astype(float) - gone[NONE])
    assert more.value > 3 * more.error


def test_one_sensor_alone_loses_the_target(found):
    """The bearings of one sensor do not tell how far the target is."""
    for name in (runs_of.ONE, runs_of.OTHER):
        gone = study.lost(found[name]["error"])
        assert (gone.mean(1) > 0.7).all()


@pytest.mark.slow
def test_the_claims(times, found, bound):
    """Each is decided by so few runs, but for one that hangs on 2 or 3 %."""
    rows = {row["claim"]: row for row in study.claims(found, bound, times)}
    holds = {name: row["holds"] for name, row in rows.items()}
    assert len(rows) == 17
    assert holds.pop("EKF (Al1) over EnKF2 at 10 s (RMSE ratio)") != "no"
    assert set(holds.values()) == {"yes"}
    gone = {name: study.lost(one["error"])[TEN] for name, one in found.items()}
    both = ~(gone[runs_of.RTS] | gone[runs_of.EKF])
    assert rows["RTS-based over EKF (Al1) at 10 s (RMSE ratio)"]["runs"] == both.sum()
