"""scipy's Riccati solver, matrix exponential and densities."""

import numpy as np
from scipy.linalg import solve_discrete_are
from scipy.stats import multivariate_normal

import ewif_jax as ej
from ewif_jax.models import constant_velocity, position_sensor


def test_the_kalman_covariance_converges_to_the_riccati_solution():
    q, r, dt, steps = 0.3, 2.0, 0.5, 200
    world = constant_velocity(sensors=position_sensor(r), q=q)
    F = np.array([[1.0, dt], [0.0, 1.0]])
    Q = q * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
    H = np.array([[1.0, 0.0]])
    predicted = solve_discrete_are(F.T, H.T, Q, np.array([[r]]))
    S = H @ predicted @ H.T + r
    expected = predicted - predicted @ H.T @ H @ predicted / S
    prior = ej.Gaussian(np.zeros(2), 10.0 * np.eye(2))
    stream = ej.stream(dt * np.arange(1, steps + 1), np.zeros(steps))
    for build in (ej.kalman, ej.information, ej.square_root):
        trace = ej.run(build(world), None, stream, prior=prior, t0=0.0)
        np.testing.assert_allclose(trace.cov[-1], expected, rtol=1e-9)
        np.testing.assert_allclose(trace.info.innovation_cov[-1], S, rtol=1e-9)


def test_the_log_likelihood_is_scipys():
    rng = np.random.default_rng(1)
    root = rng.normal(size=(3, 3))
    H, R, P = rng.normal(size=(3, 2)), root @ root.T + np.eye(3), np.diag([2.0, 0.3])
    prior, z = ej.Gaussian(rng.normal(size=2), P), rng.normal(size=3)
    world = ej.linear_model(np.eye(2), H, R)
    mask = np.array([True, False, True])
    stream = ej.stream([0.0], z[None], mask=mask[None])
    trace = ej.run(ej.kalman(world), None, stream, prior=prior, t0=0.0)
    S = (H @ P @ H.T + R)[np.ix_(mask, mask)]
    expected = multivariate_normal((H @ prior.mean)[mask], S).logpdf(z[mask])
    np.testing.assert_allclose(trace.info.log_likelihood[0], expected, rtol=1e-12)
