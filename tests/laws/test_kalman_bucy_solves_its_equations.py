"""The continuous filter against SciPy's integration of the equations as Anderson writes them."""

import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from ewif_jax.analysis.anderson_continuous import ContinuousSystem, steady_state_continuous
from ewif_jax.continuous.kalman_bucy import Signal, kalman_bucy
from ewif_jax.types import Gaussian

F, G = np.array([[0.0, 1.0], [-0.4, -0.1]]), np.array([[0.0], [1.0]])
H, Q, R = np.array([[1.0, 0.2]]), np.array([[0.3]]), np.array([[0.5]])
PRIOR = Gaussian(np.array([1.0, -1.0]), np.diag([2.0, 0.5]))
STAMPS = np.linspace(0.0, 8.0, 17)
SIGNAL = Signal(STAMPS, np.stack([np.sin(STAMPS)], 1))
TIMES = np.array([0.5, 2.0, 5.25, 8.0])


def expected(at, rate_of):
    """(3-4), (3-5) with R_alpha, Q_alpha of (3-1): the weighted noises, nothing rescaled. at(t) is
    F, G, H, Q, R."""

    def slope(t, y):
        mean, P, exponent = y[:2], y[2:6].reshape(2, 2), y[6]
        F, G, H, Q, R = at(t)
        fade = np.exp(-2 * exponent)
        K = P @ H.T / (fade * R)
        z = np.interp(t, STAMPS, SIGNAL.value[:, 0])
        P_slope = P @ F.T + F @ P - K @ H @ P + fade * G @ Q @ G.T
        return np.concatenate([F @ mean + K @ (z - H @ mean), P_slope.ravel(), [rate_of(t)]])

    start = np.concatenate([PRIOR.mean, np.ravel(PRIOR.cov), [0.0]])
    y = solve_ivp(
        slope, (TIMES[0], TIMES[-1]), start, "DOP853", TIMES, rtol=1e-11, atol=1e-13, max_step=0.05
    ).y
    return y[:2].T, (np.exp(2 * y[6]) * y[2:6]).T.reshape(-1, 2, 2)


@pytest.mark.parametrize("rate", [0.0, 0.3])
def test_constant_system(rate):
    mean, cov = expected(lambda t: (F, G, H, Q, R), lambda t: rate)
    system = ContinuousSystem(F, G, H, Q, R)
    ours = kalman_bucy(system, None, SIGNAL, prior=PRIOR, times=TIMES, fading_rate=rate)
    np.testing.assert_allclose(ours.mean, mean, rtol=1e-7, atol=1e-7)
    np.testing.assert_allclose(ours.cov, cov, rtol=1e-7, atol=1e-8)


def test_everything_varies_with_time():
    """F, G, H, Q, R and alpha, each at its own pace."""
    swings = (
        np.array([[0.1, -0.2], [0.3, 0.2]]), np.array([[0.4], [-0.3]]), np.array([[0.3, 0.5]]),
        np.array([[0.2]]), np.array([[-0.3]]),
    )  # fmt: skip
    base = F, G, H, Q, R

    def matrix(k, xp):
        return lambda p, t: base[k] + p * xp.sin((0.7 + 0.4 * k) * t) * swings[k]

    system = ContinuousSystem(*(matrix(k, jnp) for k in range(5)))
    mean, cov = expected(lambda t: [matrix(k, np)(0.8, t) for k in range(5)], lambda t: 0.1 * t)
    ours = kalman_bucy(
        system, 0.8, SIGNAL, prior=PRIOR, times=TIMES, fading_rate=lambda p, t: 0.1 * t
    )
    np.testing.assert_allclose(ours.mean, mean, rtol=1e-7, atol=1e-7)
    np.testing.assert_allclose(ours.cov, cov, rtol=1e-7, atol=1e-8)


def least_squares(rate, steps):
    """The end of the path that minimises (2-8), e^(2 alpha t) times the squared residuals of the
    start, of the input and of the measurement, on a grid of midpoints: one dense least squares."""
    first, last = TIMES[0], TIMES[-1]
    dt = (last - first) / steps
    move, push = np.eye(2) + dt * F + dt**2 / 2 * F @ F, dt * (np.eye(2) + dt / 2 * F) @ G
    middle = first + dt * (np.arange(steps) + 0.5)
    z = np.interp(middle, STAMPS, SIGNAL.value[:, 0])
    weight = np.exp(rate * (middle - first))
    rows, right = np.zeros((2 + 2 * steps, 2 + steps)), np.zeros(2 + 2 * steps)
    start = np.linalg.cholesky(np.linalg.inv(PRIOR.cov)).T
    rows[:2, :2], right[:2] = start, start @ PRIOR.mean
    state = np.eye(2, 2 + steps)
    for k in range(steps):
        after = move @ state
        after[:, 2 + k] += push[:, 0]
        looking = weight[k] * np.sqrt(dt / R[0, 0])
        rows[2 + k], right[2 + k] = looking * (H @ (state + after) / 2)[0], looking * z[k]
        rows[2 + steps + k, 2 + k] = weight[k] * np.sqrt(dt / Q[0, 0])
        state = after
    return state @ np.linalg.lstsq(rows, right, rcond=None)[0]


@pytest.mark.parametrize("rate", [0.0, 0.3])
def test_it_minimises_the_weighted_cost(rate):
    """(2-8) on two grids, extrapolated to a step of 0, is the filter of (3-4), (3-5)."""
    ours = kalman_bucy(
        ContinuousSystem(F, G, H, Q, R), None, SIGNAL, prior=PRIOR, times=TIMES, fading_rate=rate
    )
    coarse, fine = least_squares(rate, 300), least_squares(rate, 600)
    np.testing.assert_allclose((4 * fine - coarse) / 3, ours.mean[-1], atol=2e-4)
    assert np.abs(fine - ours.mean[-1]).max() < 0.02


def test_settles_in_the_steady_state():
    system = ContinuousSystem(F, G, H, Q, R)
    long = Signal(np.array([0.0, 60.0]), np.zeros((2, 1)))
    ours = kalman_bucy(
        system, None, long, prior=PRIOR, times=np.array([0.0, 60.0]), fading_rate=0.3
    )
    steady = steady_state_continuous(system, fading_rate=0.3)
    np.testing.assert_allclose(ours.cov[-1], steady.cov, rtol=1e-7)
    np.testing.assert_allclose(ours.gain[-1], steady.gain, rtol=1e-7)


def test_gradient_is_the_finite_difference():
    system = ContinuousSystem(F, G, H, lambda p, t: p["q"] * jnp.eye(1), R)

    @jax.jit
    def loss(q, rate):
        params = {"q": q, "rate": rate}
        track = kalman_bucy(
            system, params, SIGNAL, prior=PRIOR, times=TIMES, fading_rate=lambda p, t: p["rate"]
        )
        return jnp.sum(track.mean**2) + jnp.sum(track.cov)

    slopes = jax.jit(jax.grad(loss, argnums=(0, 1)))(0.3, 0.2)
    for k, step in enumerate([(1e-4, 0.0), (0.0, 1e-4)]):
        up, down = loss(0.3 + step[0], 0.2 + step[1]), loss(0.3 - step[0], 0.2 - step[1])
        np.testing.assert_allclose(slopes[k], (up - down) / 2e-4, rtol=1e-5)


def test_bad_input_is_named(monkeypatch):
    system = ContinuousSystem(F, G, H, Q, R)
    for times, word in ((TIMES[::-1], "times"), (TIMES + 1, "within the signal")):
        with pytest.raises(ValueError, match=word):
            kalman_bucy(system, None, SIGNAL, prior=PRIOR, times=times)
    with pytest.raises(ValueError, match="fading_rate"):
        kalman_bucy(system, None, SIGNAL, prior=PRIOR, times=TIMES, fading_rate=-1.0)
    monkeypatch.setitem(sys.modules, "diffrax", None)
    with pytest.raises(ImportError, match=r"ewif_jax\[continuous\]"):
        kalman_bucy(system, None, SIGNAL, prior=PRIOR, times=TIMES[:3])
