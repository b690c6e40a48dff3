"""dynamax's `lgssm_filter` is our Kalman filter on equally spaced data (it adds 1e-9 to S)."""

import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import ewif_jax as ej


def test_linear_gaussian_filter():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        inference = pytest.importorskip("dynamax.linear_gaussian_ssm.inference")
    rng = np.random.default_rng(0)
    F, H = np.array([[1.0, 0.1], [0.0, 0.9]]), np.array([[1.0, 0.0], [0.5, 1.0]])
    Q, R, P = np.diag([0.01, 0.1]), np.array([[0.5, 0.1], [0.1, 1.0]]), np.diag([2.0, 3.0])
    b, mean, values = np.array([0.2, -0.1]), np.array([1.0, 0.0]), rng.normal(size=(30, 2))
    params = inference.ParamsLGSSM(
        initial=inference.ParamsLGSSMInitial(mean=mean, cov=P),
        dynamics=inference.ParamsLGSSMDynamics(
            weights=F, bias=b, input_weights=np.zeros((2, 0)), cov=Q
        ),
        emissions=inference.ParamsLGSSMEmissions(
            weights=H, bias=np.zeros(2), input_weights=np.zeros((2, 0)), cov=R
        ),
    )
    theirs = inference.lgssm_filter(jax.tree.map(jnp.asarray, params), jnp.asarray(values))
    trace = ej.run(
        ej.kalman(ej.linear_model(F, H, R, Q, b)),
        None,
        ej.stream(np.arange(30.0), values),
        prior=ej.Gaussian(mean, P),
        t0=0.0,
    )
    np.testing.assert_allclose(trace.mean, theirs.filtered_means, rtol=1e-8, atol=1e-8)
    np.testing.assert_allclose(trace.cov, theirs.filtered_covariances, rtol=1e-8, atol=1e-8)
    np.testing.assert_allclose(trace.info.log_likelihood.sum(), theirs.marginal_loglik, rtol=1e-9)
