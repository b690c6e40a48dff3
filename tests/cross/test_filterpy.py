"""filterpy's `KalmanFilter(alpha=a)` is Anderson's filter (5-13)-(5-15) (ERRATA 17), and its
`IMMEstimator` mixes models as `imm` does."""

import numpy as np
import pytest

import ewif_jax as ej

filterpy = pytest.importorskip("filterpy.kalman")


@pytest.mark.parametrize("alpha", [1.0, 1.02, 1.3])
def test_fading_filter(alpha):
    rng = np.random.default_rng(0)
    F, H = np.array([[1.0, 0.1], [0.0, 1.0]]), np.array([[1.0, 0.0], [0.5, 1.0]])
    Q, R = np.diag([0.01, 0.1]), np.diag([0.5, 1.0])
    values = rng.normal(size=(30, 2))
    theirs = filterpy.KalmanFilter(dim_x=2, dim_z=2)
    theirs.x, theirs.P = np.array([[1.0], [0.0]]), np.diag([2.0, 3.0])
    theirs.F, theirs.H, theirs.Q, theirs.R, theirs.alpha = F, H, Q, R, alpha
    prior = ej.Gaussian(theirs.x[:, 0], theirs.P)
    trace = ej.run(
        ej.fading(ej.linear_model(F, H, R, Q), alpha),
        None,
        ej.stream(np.arange(1.0, 31.0), values),
        prior=prior,
        t0=0.0,
    )
    for k, z in enumerate(values):
        theirs.predict()
        theirs.update(z[:, None])
        np.testing.assert_allclose(trace.mean[k], theirs.x[:, 0], rtol=1e-10)
        np.testing.assert_allclose(trace.cov[k], theirs.P, rtol=1e-10, atol=1e-14)
        np.testing.assert_allclose(trace.info.innovation_cov[k], theirs.S, rtol=1e-10, atol=1e-14)
        np.testing.assert_allclose(trace.info.log_likelihood[k], theirs.log_likelihood, rtol=1e-9)


def test_interacting_multiple_models():
    rng = np.random.default_rng(1)
    F, H, R = np.array([[1.0, 0.5], [0.0, 1.0]]), np.array([[1.0, 0.0]]), np.eye(1)
    noises = [np.diag([1e-3, 1e-3]), np.array([[0.2, 0.5], [0.5, 2.0]])]
    change, start = np.array([[0.9, 0.1], [0.2, 0.8]]), np.array([0.6, 0.4])
    values = np.cumsum(rng.normal(size=(25, 1)), 0)
    theirs = []
    for Q in noises:
        one = filterpy.KalmanFilter(dim_x=2, dim_z=1)
        one.x, one.P = np.array([[1.0], [0.0]]), np.diag([2.0, 3.0])
        one.F, one.H, one.Q, one.R = F, H, Q, R
        theirs.append(one)
    both = filterpy.IMMEstimator(theirs, start.copy(), change)
    modes = ej.imm([ej.kalman(ej.linear_model(F, H, R, Q)) for Q in noises], change, start)
    prior = ej.Gaussian(np.array([1.0, 0.0]), np.diag([2.0, 3.0]))
    state = modes.init(None, prior, 0.0)
    for arrival in ej.arrivals(ej.stream(np.arange(1.0, 26.0), values)):
        state, _ = ej.step(modes, None, state, arrival)
        both.predict()
        both.update(arrival.value)
        mean, cov = modes.estimate(None, state)
        np.testing.assert_allclose(mean, both.x[:, 0], rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(cov, both.P, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(ej.imm_probabilities(state), both.mu, rtol=1e-9)
