"""Priors float32 cannot hold are refused; what it holds is right; no variance is negative."""

import jax
import numpy as np
import pytest

import ewif_jax as ej

MODEL = ej.models.constant_velocity(sensors=ej.models.position_sensor(0.01), q=0.1)
RNG = np.random.default_rng(0)
TIME = np.cumsum(RNG.uniform(0.5, 1.5, 16)).astype(np.float32)
TIME[[9, 13]] -= np.float32(1.2)
VALUE = (0.5 * TIME + 0.1 * RNG.normal(size=16)).astype(np.float32)
BUILDERS = {
    "kalman": lambda m: ej.kalman(m),
    "al1": lambda m: ej.al1(m, 4),
    "asd": lambda m: ej.asd(m, 4),
    "replay": lambda m: ej.replay(ej.kalman(m), 4),
    "fixed_lag": lambda m: ej.fixed_lag(m, 2),
}


def filtered(build, variances, dtype=np.float32):
    prior = ej.Gaussian(np.zeros(2, dtype), np.diag(variances).astype(dtype))
    data = ej.stream(TIME.astype(dtype), VALUE.astype(dtype))
    return ej.run(build(MODEL), None, data, prior=prior, t0=0.0)


def test_what_float32_holds_is_what_float64_gives():
    with jax.enable_x64(True):
        right = filtered(BUILDERS["replay"], [100.0, 100.0], np.float64)
        sd = np.sqrt(np.diagonal(np.asarray(right.cov), axis1=1, axis2=2))
    for name in ("asd", "replay"):
        trace = filtered(BUILDERS[name], [100.0, 100.0])
        assert np.max(np.abs(trace.mean - right.mean) / sd) < 1e-2


@pytest.mark.parametrize("build", BUILDERS.values(), ids=BUILDERS)
@pytest.mark.parametrize("variances", [[1e6, 1e6], [1.0, 1e8]])
def test_what_it_cannot_hold_is_refused_by_name(build, variances):
    with pytest.raises(ValueError, match=r"prior\.cov: .* square_root or information.*float64"):
        filtered(build, variances)


def test_a_vague_position_beside_a_known_velocity_is_held():
    """Rounding of a variance that the first measurement replaces is lost with it."""
    trace = filtered(BUILDERS["kalman"], [1e8, 1.0])
    assert abs(float(trace.cov[0, 0, 0]) - 0.01) < 1e-6


@pytest.mark.parametrize("build", BUILDERS.values(), ids=BUILDERS)
def test_where_nothing_is_known_no_variance_is_negative(build):
    def variances(width):
        prior = ej.Gaussian(np.zeros(2, np.float32), width * np.eye(2, dtype=np.float32))
        trace = ej.run(build(MODEL), None, ej.stream(TIME, VALUE), prior=prior, t0=0.0)
        return np.float32(1) * jax.numpy.diagonal(trace.cov, axis1=1, axis2=2)

    assert np.min(jax.jit(jax.vmap(variances))(np.float32([1e5, 1e6, 1e8]))) >= 0
