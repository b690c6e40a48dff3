"""Exact measurements (R = 0, singular R) in the analysis: the limit of small R where there is one,
as iterating the Riccati equation in NumPy gives, otherwise refused by a message that names R."""

import jax
import numpy as np
import pytest

import ewif_jax as ej

CV, POSITION = np.array([[1.0, 1], [0, 1]]), np.array([[1.0, 0]])
WHITE = 0.1 * np.array([[1 / 3, 0.5], [0.5, 1]])
SYSTEMS = {
    "R = 0": (CV, POSITION, 0.1 * np.eye(2), np.zeros((1, 1))),
    "white acceleration": (CV, POSITION, WHITE, np.zeros((1, 1))),
    "singular R": (
        np.array([[0, 0], [-1, 2.0]]),
        np.array([[1.0, 1], [0, 1]]),
        np.diag([1.0, 0.5]),
        np.array([[4.0, 2], [2, 1]]),
    ),
    "one exact component": (CV, np.eye(2), WHITE, np.diag([0.3, 0.0])),
    "growing": (np.array([[1.2, 1], [0, 0.5]]), POSITION, WHITE, np.zeros((1, 1))),
    "regular": (CV, POSITION, WHITE, np.eye(1)),
}


def iterated(F, H, Q, R):
    P = np.eye(len(F))
    for _ in range(3000):
        K = np.linalg.solve(H @ P @ H.T + R, H @ P).T
        kept = np.eye(len(F)) - K @ H
        P = F @ (kept @ P @ kept.T + K @ R @ K.T) @ F.T + Q
    return np.linalg.solve(H @ P @ H.T + R, H @ P).T


@pytest.mark.parametrize("name", SYSTEMS)
def test_steady_gain(name):
    system = SYSTEMS[name]
    expected = iterated(*system)
    np.testing.assert_allclose(ej.steady_state_gain(*system), expected, rtol=1e-8, atol=1e-9)
    traced = jax.jit(ej.steady_state_gain)(*system)
    np.testing.assert_allclose(traced, expected, rtol=1e-8, atol=1e-9)
    single = ej.steady_state_gain(*(np.asarray(x, np.float32) for x in system))
    np.testing.assert_allclose(single, expected, rtol=2e-3, atol=2e-4)


def test_held_acceleration_is_known_from_positions():
    """Slowly: the iteration comes as near as 1 / steps. The limit of alpha and beta is 1 and 2."""
    noise = np.outer([0.5, 1], [0.5, 1])
    found = ej.steady_state_gain(CV, POSITION, noise, np.zeros((1, 1)))
    np.testing.assert_allclose(found, [[1.0], [2.0]], rtol=1e-9)


def test_derivative_at_an_exact_measurement():
    F, H, Q, R = SYSTEMS["R = 0"]
    slope = jax.jacobian(lambda r: ej.steady_state_gain(F, H, Q, r * np.eye(1)))(0.0)
    step = 1e-5
    difference = (iterated(F, H, Q, step * np.eye(1)) - iterated(F, H, Q, R)) / step
    np.testing.assert_allclose(slope, difference, rtol=1e-3)


NOTHING_MOVES = {
    "nothing moves": (CV, POSITION, np.zeros((2, 2)), np.zeros((1, 1))),
    "a number": (1.0, 1.0, 0.0, 0.0),
    "seen twice": (CV, np.vstack([POSITION, POSITION]), WHITE, np.ones((2, 2))),
}


@pytest.mark.parametrize("name", NOTHING_MOVES)
def test_no_steady_gain(name):
    for function in (ej.steady_state_gain, ej.cutoff_delay, lambda *s: ej.delayed_gain(*s, 2)):
        with pytest.raises(ValueError, match=r"^R: "):
            function(*NOTHING_MOVES[name])


STREAM = ej.stream(np.arange(1.0, 4), np.zeros((3, 2)))
AT = {"start": np.zeros(2), "prior_cov": np.eye(2), "t0": 0.0}
TRUTH = np.zeros((3, 2))


def model_of(R):
    return ej.linear_model(CV, np.eye(2), R, WHITE)


@pytest.mark.parametrize(
    "R", [np.zeros((2, 2)), np.diag([1.0, 0]), np.ones((2, 2)), lambda p: p["r"] * np.ones((2, 2))]
)
def test_bounds_refuse_exact_measurements(R):
    model, params = model_of(R), {"r": 2.0}
    late = {**AT, "times": np.arange(1.0, 4)}
    for bound in (
        lambda: ej.crlb(model, params, STREAM, state=np.zeros(2), time=3.0),
        lambda: ej.pcrlb(model, params, STREAM, TRUTH, **AT),
        lambda: ej.pcrlb_late(model, params, STREAM, TRUTH, **late),
        lambda: ej.analysis.pcrlb_equivalent(model, params, STREAM, TRUTH, **late),
    ):
        with pytest.raises(ValueError, match=r"^R: .* no finite information"):
            bound()


def test_what_is_masked_may_be_exact():
    """Only components that are there count; small variances in any units are no exact ones."""
    here = STREAM._replace(mask=np.tile([True, False], (3, 1)))
    for R in (np.diag([1.0, 0]), np.diag([1.0, 1e-30])):
        found = ej.pcrlb(model_of(R), None, here, TRUTH, **AT)
        P = np.eye(2)
        for k in range(3):
            P = CV @ P @ CV.T + WHITE
            P = P - np.outer(P[:, 0], P[0]) / (P[0, 0] + 1)
            np.testing.assert_allclose(found[k], P, rtol=1e-9)
