"""Late measurements where motion back in time is no way: fast stable modes and a singular F."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import ewif_jax as ej

RATES = np.array([-10.0, -0.1])
TIME = np.array([1.0, 2.0, 3.0, 2.25, 4.0, 3.5])
VALUE = np.array([0.3, -0.8, 0.5, 1.1, -0.2, 0.7])
METHODS = {
    "a1": ej.a1,
    "al1": lambda m: ej.al1(m, 4),
    "asd": lambda m: ej.asd(m, 4),
    "rts_reference": lambda m: ej.rts_reference(m, 4),
}


def decaying():
    def F(params, a, b):
        return jnp.diag(jnp.exp(jnp.asarray(RATES, jnp.result_type(a)) * (b - a)))

    def Q(params, a, b):
        return jnp.diag(1 - jnp.exp(2 * jnp.asarray(RATES, jnp.result_type(a)) * (b - a)))

    return ej.linear_model(F, np.array([[1.0, 1.0]]), 0.1 * np.eye(1), Q)


def joint_posterior(time, value):
    """Mean and covariance at the newest time, by conditioning on all values at once."""
    now = time.max()
    within = np.exp(RATES[:, None, None] * np.abs(time[:, None] - time[None])).sum(0)
    cross = np.exp(RATES[:, None] * (now - time))
    gain = np.linalg.solve(within + 0.1 * np.eye(len(time)), cross.T).T
    return gain @ value, np.eye(2) - gain @ cross.T


@pytest.mark.parametrize("build", METHODS.values(), ids=METHODS)
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_a_fast_stable_mode(build, dtype):
    """The stationary prior makes the joint density a plain one; one late value per interval."""
    with jax.enable_x64(dtype == np.float64):
        prior = ej.Gaussian(np.zeros(2, dtype), np.eye(2, dtype=dtype))
        data = ej.stream(TIME[:4].astype(dtype), VALUE[:4].astype(dtype))
        trace = ej.run(build(decaying()), None, data, prior=prior, t0=0.0)
    mean, cov = joint_posterior(TIME[:4], VALUE[:4])
    assert trace.info.status[-1] == ej.Status.LATE_USED
    atol = 1e-9 if dtype == np.float64 else 1e-5
    np.testing.assert_allclose(trace.mean[-1], mean, atol=atol)
    np.testing.assert_allclose(trace.cov[-1], cov, atol=atol)


@pytest.mark.parametrize("build", [ej.b1, lambda m: ej.bl1(m, 4)])
def test_a_singular_constant_is_refused_where_it_would_be_inverted(build):
    model = ej.linear_model(np.diag([0.0, 1.0]), np.eye(2), np.eye(2), np.eye(2))
    with pytest.raises(ValueError, match="model: expected a model whose F has an inverse"):
        build(model)


@pytest.mark.parametrize("build", METHODS.values(), ids=METHODS)
def test_a_singular_constant_elsewhere(build):
    """The first component is new noise at each step, so its late value says nothing of now."""
    model = ej.linear_model(np.diag([0.0, 1.0]), np.eye(2), np.eye(2), np.diag([1.0, 0.0]))
    data = ej.stream([1.0, 2.0, 1.0], np.array([[0.4, 1.0], [0.6, 2.0], [5.0, 6.0]], np.float32))
    prior = ej.Gaussian(np.zeros(2, np.float32), np.eye(2, dtype=np.float32))
    trace = ej.run(build(model), None, data, prior=prior, t0=0.0)
    np.testing.assert_allclose(trace.mean[-1], [0.3, 9 / 4], atol=1e-5)
    np.testing.assert_allclose(trace.cov[-1], np.diag([0.5, 0.25]), atol=1e-5)
