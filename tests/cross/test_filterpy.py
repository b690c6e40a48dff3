"""filterpy's `KalmanFilter(alpha=a)` is Anderson's filter (5-13)-(5-15) (ERRATA 17)."""

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
