"""The derivative at q = 0 and r = 0 is the slope, which only one side has: by NumPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import ewif_jax as ej

TIME = np.arange(1.0, 9.0)
VALUE = np.sin(TIME)
SENSORS = ej.models.position_sensor(lambda p: p["r"])
MODELS = {
    "constant velocity": (
        ej.models.constant_velocity(sensors=SENSORS, q=lambda p: p["q"]),
        np.array([[1.0, 1.0], [0.0, 1.0]]),
        np.array([[1 / 3, 1 / 2], [1 / 2, 1.0]]),
    ),
    "unstable": (
        ej.linear_model(
            2.0 * np.eye(2), np.array([[1.0, 0.0]]), lambda p: p["r"] * jnp.eye(1),
            lambda p: p["q"] * jnp.eye(2),
        ),
        2.0 * np.eye(2),
        np.eye(2),
    ),
}  # fmt: skip


def loss_by_hand(F, Q, cov, q, r):
    """Mean negative log likelihood of a NumPy Kalman filter in long double."""
    x, P, total = np.zeros(2, np.longdouble), cov.astype(np.longdouble), 0.0
    for z in VALUE:
        x, P = F @ x, F @ P @ F.T + q * Q
        S, nu = P[0, 0] + r, z - x[0]
        total += (np.log(2 * np.pi * S) + nu**2 / S) / 2
        K = P[:, 0] / S
        x, P = x + K * nu, P - np.outer(K, P[0])
    return total / len(VALUE)


def slope_by_hand(F, Q, cov, at, name):
    """From the right, to third order."""
    step = np.longdouble(1e-7)
    shifts, weights = (0, 1, 2, 3), (-11 / 6, 3.0, -3 / 2, 1 / 3)
    moved = [{**at, name: at[name] + k * step} for k in shifts]
    return sum(w * loss_by_hand(F, Q, cov, **p) for w, p in zip(weights, moved, strict=True)) / step


@pytest.mark.parametrize("dtype", [pytest.param(np.float64, marks=pytest.mark.slow), np.float32])
@pytest.mark.parametrize("name", MODELS)
def test_square_root_and_kalman(name, dtype):
    model, F, Q = MODELS[name]
    for build in (ej.square_root, ej.kalman):
        slopes = jax.jit(jax.grad(lambda p, cov: loss_of(build(model), cov, dtype)(p)))  # noqa: B023
        for cov, at in (
            (np.diag([2.0, 1.0]), {"q": 0.0, "r": 0.5}),
            (np.zeros((2, 2)), {"q": 0.0, "r": 0.5}),
            (np.diag([2.0, 0.0]), {"q": 0.0, "r": 0.5}),
            (np.diag([2.0, 1.0]), {"q": 0.3, "r": 0.0}),
        ):
            given = {k: np.asarray(v, dtype) for k, v in at.items()}
            found = slopes(given, cov.astype(dtype))
            for parameter, slope in found.items():
                right = slope_by_hand(F, Q, cov, at, parameter)
                tight = 1e-5 if dtype == np.float64 else 2e-3
                np.testing.assert_allclose(float(slope), float(right), rtol=tight)


def loss_of(estimator, cov, dtype):
    prior = ej.Gaussian(np.zeros(2, dtype), cov)
    data = ej.stream(TIME.astype(dtype), VALUE.astype(dtype))
    return ej.likelihood_loss(estimator, data, prior=prior, t0=0.0)


def test_what_is_known_exactly_stays_so():
    model = MODELS["unstable"][0]
    data = ej.stream(np.arange(1.0, 101.0), np.ones(100))
    prior = ej.Gaussian(np.zeros(2), np.diag([0.0, 1.0]))
    trace = ej.run(ej.square_root(model), {"q": 0.0, "r": 0.5}, data, prior=prior, t0=0.0)
    assert np.max(trace.cov[:, 0, 0]) < 1e-200
    np.testing.assert_allclose(trace.mean[:, 0], 0, atol=1e-150)
