"""Al1 against the exact answer, in expectation: where it gains, and where dropping is better."""

import numpy as np
import pytest
from oracles import joint_gaussian, kalman_loop, late

from ewif_jax.study.papers.late_loss import runs as late_loss

KNOWN = {
    ("random walk", 1): ("1.219", "1.000"),
    ("random walk", 2): ("1.028", "1.009"),
    ("random walk", 3): ("1.004", "1.014"),
    ("random walk", 5): ("1.000", "1.011"),
    ("white-noise acceleration", 1): ("1.317", "1.000"),
    ("white-noise acceleration", 2): ("1.021", "1.0015"),
    ("white-noise acceleration", 3): ("1.0002", "1.0037"),
}
"""drop and Al1 over exact, computed once by other means and rounded"""
MOTIONS = {
    "random walk": (lambda dt: np.eye(1), lambda dt: dt * np.eye(1)),
    "white-noise acceleration": (
        lambda dt: np.array([[1.0, dt], [0.0, 1.0]]),
        lambda dt: np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]]),
    ),
}


@pytest.fixture(scope="module")
def table():
    return {(row["motion"], row["lags back"]): row for row in late_loss.relative_errors()}


def test_the_known_figures(table):
    for case, figures in KNOWN.items():
        for name, figure in zip(("drop", "al1"), figures, strict=True):
            last_digit = 10.0 ** -len(figure.partition(".")[2])
            assert table[case][name] == pytest.approx(float(figure), abs=0.6 * last_digit)


def test_one_lag_back_a1_is_exact_and_b1_is_not(table):
    for motion in MOTIONS:
        row = table[motion, 1]
        for name in ("a1", "al1"):
            assert row[name] == pytest.approx(1, abs=1e-12)
        assert row["b1"] == pytest.approx(row["bl1"], abs=1e-12)
        assert row["b1"] > 1 + 1e-5
        for lag in late_loss.LAGS[1:]:
            row = table[motion, lag]
            assert row["a1"] == pytest.approx(row["drop"], abs=1e-12)
            assert row["b1"] == pytest.approx(row["drop"], abs=1e-12)


def test_at_three_lags_dropping_is_better_and_al1_is_optimistic(table):
    for motion in MOTIONS:
        assert table[motion, 3]["al1"] > table[motion, 3]["drop"]
    told = [row["al1, computed / true"] for row in table.values()]
    assert min(told) == pytest.approx(0.95, abs=0.005)
    assert max(told) < 1 + 1e-12


@pytest.mark.parametrize("motion", MOTIONS)
@pytest.mark.parametrize("rule", [late.al1, late.bl1])
def test_the_expected_errors_are_those_of_the_published_equations(table, motion, rule):
    """By the equations applied to unit vectors, and the joint Gaussian of states and values."""
    move, noise = MOTIONS[motion]
    n = move(1.0).shape[0]
    model = {"F": lambda a, b: move(b - a), "Q": lambda a, b: noise(b - a)}
    start = {"t0": 0.0, "prior_cov": np.eye(n)}
    H, R = np.eye(1, n), np.eye(1)
    for lag in late_loss.LAGS:
        times = late_loss.arrival_pairs(lag)
        steps = times.size - 1

        def last(values, times=times, steps=steps):
            track = kalman_loop.kalman_filter(
                **start, **model, prior_mean=np.zeros(n), times=times[:-1], H=[H] * steps,
                R=[R] * steps, values=values[:-1, None],
            )  # fmt: skip
            k = int(times[-1] - 0.5)
            known = late.lag_interval(
                float(k), track.means[k - 1], track.covs[k - 1], times[-1], times[-2], **model
            )
            return rule(track.means[-1], track.covs[-1], known, H, R, values[-1:])[0]

        response = np.stack([last(unit) for unit in np.eye(steps + 1)], axis=1)
        grid, _, cov = joint_gaussian.joint(times, **start, **model, prior_mean=np.zeros(n))
        see = np.stack([np.kron(grid == t, H[0]) for t in times])
        pick = np.kron(grid == times[-2], np.eye(n))
        S, cross = see @ cov @ see.T + np.eye(steps + 1), pick @ cov @ see.T
        off = cross - response @ S
        mse = pick @ cov @ pick.T - cross @ response.T - response @ off.T
        best = pick @ cov @ pick.T - cross @ np.linalg.solve(S, cross.T)
        expected = mse[0, 0] / best[0, 0]
        assert table[motion, lag][rule.__name__] == pytest.approx(expected, abs=1e-10)
