"""What every delayed-measurement method owes: gradients, nothing from what it drops, a covariance.

All streams are padded to one length, so that each method is compiled once.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import ewif_jax as ej
from ewif_jax.models import constant_velocity, position_sensor
from ewif_jax.oosm.a1 import a1
from ewif_jax.oosm.al1 import al1
from ewif_jax.oosm.asd import asd
from ewif_jax.oosm.b1 import b1
from ewif_jax.oosm.bl1 import bl1
from ewif_jax.oosm.replay import replay
from ewif_jax.oosm.selective import selective

MODEL = constant_velocity(
    sensors=[position_sensor(lambda p: p["r"]), position_sensor(lambda p: 3 * p["r"])],
    q=lambda p: p["q"],
)
PRIOR = ej.Gaussian(np.array([0.3, -1.0]), np.diag([2.0, 0.5]))
PARAMS = {"q": 0.3, "r": 0.5, "tau": 1.5}
METHODS = {
    "a1": a1(MODEL),
    "b1": b1(MODEL),
    "al1": al1(MODEL, 5),
    "bl1": bl1(MODEL, 5),
    "asd": asd(MODEL, 5),
    "replay": replay(ej.kalman(MODEL), 5),
    "selective": selective(al1(MODEL, 5), 0.9),
    "ewif": ej.ewif(MODEL, tau=lambda p: p["tau"]),
}
each = pytest.mark.parametrize("method", METHODS.values(), ids=METHODS)


LENGTH = 40


def data(times, dtype=np.float64):
    rng = np.random.default_rng(0)
    rest = LENGTH - len(times)
    return ej.stream(
        np.append(times, np.full(rest, np.max(times))).astype(dtype),
        rng.normal(size=LENGTH).astype(dtype),
        rng.integers(0, 2, LENGTH),
        mask=np.arange(LENGTH) < len(times),
    )


LATE = data([0.0, 0.5, 1.0, 0.8, 1.0, 2.0, 1.2, 0.7, 1.9, 3.0, 2.5])


@pytest.mark.slow  # the contracts say it of every estimator
@each
def test_gradients_equal_finite_differences(method):
    names = sorted(PARAMS)

    def loss(vector):
        params = dict(zip(names, vector, strict=True))
        trace = ej.run(method, params, LATE, prior=PRIOR, t0=0.0)
        return jnp.sum(trace.mean**2) + jnp.sum(trace.cov) + jnp.sum(trace.info.log_likelihood)

    at, h = jnp.array([PARAMS[name] for name in names]), 1e-5
    shifts = h * jnp.concatenate([jnp.eye(3), -jnp.eye(3)])
    values = jax.jit(jax.vmap(loss))(at[None] + shifts)
    expected = (values[:3] - values[3:]) / (2 * h)
    np.testing.assert_allclose(jax.jit(jax.grad(loss))(at), expected, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(jax.jit(jax.jacfwd(loss))(at), expected, rtol=1e-5, atol=1e-6)


@each
def test_gradients_are_finite_without_noise_or_information(method):
    """Zero process noise, a certain prior and masked data."""

    def loss(q):
        stream = LATE._replace(mask=LATE.mask.at[jnp.array([3, 5])].set(False))
        prior = PRIOR._replace(cov=np.diag([1.0, 1e-3]))
        trace = ej.run(method, PARAMS | {"q": q}, stream, prior=prior, t0=0.0)
        return jnp.sum(trace.mean) + jnp.sum(trace.info.log_likelihood)

    value, slope = jax.jit(jax.value_and_grad(loss))(0.0)
    assert np.isfinite(value)
    assert np.isfinite(slope)


@each
def test_delay_zero_is_the_in_sequence_update(method):
    stream = data([0.0, 0.5, 0.5, 1.0, 1.0, 2.0])
    trace = ej.run(method, PARAMS, stream, prior=PRIOR, t0=0.0)
    reference = METHODS["ewif"] if method is METHODS["ewif"] else ej.kalman(MODEL)
    expected = ej.run(reference, PARAMS, stream, prior=PRIOR, t0=0.0)
    np.testing.assert_allclose(trace.mean, expected.mean, atol=1e-12)
    np.testing.assert_allclose(trace.cov, expected.cov, atol=1e-12)
    np.testing.assert_array_equal(trace.info.status[:6], ej.Status.USED)


@pytest.mark.parametrize("name", [name for name in METHODS if name != "ewif"])
def test_too_late_and_before_t0_change_nothing(name):
    times = [0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 3.5, 0.4, -1.0]
    trace = ej.run(METHODS[name], PARAMS, data(times), prior=PRIOR, t0=0.0)
    for k in (7, 8):
        assert trace.info.status[k] == ej.Status.TOO_LATE
        assert trace.info.log_likelihood[k] == 0
        np.testing.assert_array_equal(trace.mean[k], trace.mean[6])
        np.testing.assert_array_equal(trace.cov[k], trace.cov[6])
    np.testing.assert_allclose(trace.info.delay[7:9], [3.1, 4.5])


@pytest.mark.slow  # the contracts say it of every estimator
@each
def test_float32_is_close_to_float64(method):
    def trace(dtype):
        prior = ej.Gaussian(PRIOR.mean.astype(dtype), PRIOR.cov.astype(dtype))
        return ej.run(method, PARAMS, data(LATE.time, dtype), prior=prior, t0=0.0)

    single, double = trace(np.float32), trace(np.float64)
    assert single.mean.dtype == np.float32
    np.testing.assert_allclose(single.mean, double.mean, atol=1e-4)
    np.testing.assert_allclose(single.cov, double.cov, atol=1e-4)


@each
def test_the_covariance_stays_symmetric_and_psd(method):
    rng = np.random.default_rng(1)
    trace = ej.run(method, PARAMS, data(rng.uniform(0, 5, LENGTH)), prior=PRIOR, t0=0.0)
    np.testing.assert_allclose(trace.cov, np.swapaxes(trace.cov, 1, 2), atol=1e-15)
    assert np.linalg.eigvalsh(trace.cov).min() > -1e-12


@pytest.mark.parametrize("build", [lambda m: al1(m, 0), lambda m: asd(m, 0), lambda m: bl1(m, 1.5)])
def test_a_bad_lag_is_refused(build):
    with pytest.raises(ValueError, match="lag: expected a whole number >= 1"):
        build(MODEL)


@pytest.mark.parametrize("build", [a1, b1, lambda m: al1(m, 2), lambda m: asd(m, 2)])
def test_a_missing_prior_and_a_bad_model_are_refused(build):
    with pytest.raises(ValueError, match="prior: expected a Gaussian"):
        ej.run(build(MODEL), PARAMS, LATE, prior=None, t0=0.0)
    with pytest.raises(ValueError, match="model: expected a Model"):
        build("model")


@pytest.mark.parametrize("name", ["al1", "asd", "selective"])
def test_a_batch_along_the_last_axis_is_the_loop(name):
    """The fast layout: scan over vmap(step, in_axes=-1, out_axes=-1)."""
    method, runs = METHODS[name], 3
    values = np.random.default_rng(2).normal(size=(LENGTH, 1, runs))
    spread = jax.tree.map(lambda x: jnp.stack([x] * runs, -1), LATE)._replace(value=values)
    first = method.init(PARAMS, PRIOR, jnp.zeros(()))
    first = jax.tree.map(lambda x: jnp.stack([x] * runs, -1), first)
    one = jax.vmap(lambda s, z: ej.step(method, PARAMS, s, z)[0], in_axes=-1, out_axes=-1)
    last, _ = jax.lax.scan(lambda s, z: (one(s, z), None), first, spread)
    means = jax.vmap(lambda s: method.estimate(PARAMS, s).mean, in_axes=-1)(last)
    for k in range(runs):
        alone = ej.run(method, PARAMS, LATE._replace(value=values[..., k]), prior=PRIOR, t0=0.0)
        np.testing.assert_allclose(means[k], alone.mean[-1], atol=1e-12)
