"""Information forms: exact measurements, motion that is stable and fast, long gaps, gradients."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import ewif_jax as ej

PRIOR = ej.Gaussian(jnp.zeros(2), jnp.eye(2))
DATA = ej.stream(np.arange(3.0), np.array([5.0, 7.0, 9.0]))
WEIGHT = lambda p, a, b: jnp.exp((a - b) / 4)  # noqa: E731


def walk(r):
    return ej.models.constant_velocity(sensors=ej.models.position_sensor(r), q=0.2)


REFUSING = {
    "ewif": lambda m: ej.run(ej.ewif(m, 2.0), None, DATA, prior=PRIOR, t0=0.0),
    "fixed_lag_ewif": lambda m: ej.run(
        ej.fixed_lag_ewif(m, 2.0, lag=0.5), None, DATA, prior=PRIOR, t0=0.0
    ),
    "limited_memory": lambda m: ej.run(
        ej.limited_memory(m, 9.0, 8), None, DATA, prior=PRIOR, t0=0.0
    ),
    "batch_wls": lambda m: ej.batch_wls(m, None, DATA, np.array([2.0]), weight=WEIGHT),
    "two_sided_ewif": lambda m: ej.two_sided_ewif(m, None, DATA, tau=2.0),
    "run_parallel": lambda m: ej.run_parallel(m, None, DATA, tau=2.0, prior=PRIOR, t0=0.0),
}


@pytest.mark.parametrize("name", REFUSING)
def test_a_known_exact_measurement_is_refused_by_name(name):
    with pytest.raises(ValueError, match="R: expected a positive definite"):
        REFUSING[name](walk(0.0))


def test_information_takes_an_exact_measurement_as_kalman():
    found, expected = (
        ej.run(f(walk(0.0)), None, DATA, prior=PRIOR, t0=0.0) for f in (ej.information, ej.kalman)
    )
    np.testing.assert_allclose(found.mean, expected.mean, atol=1e-9)
    np.testing.assert_allclose(found.cov, expected.cov, atol=1e-9)


def test_a_traced_exact_measurement_is_rejected():
    model = walk(lambda p: p["r"])
    run = jax.jit(lambda p: ej.run(ej.ewif(model, 2.0), p, DATA, prior=PRIOR, t0=0.0))
    trace = run({"r": 0.0})
    assert (trace.info.status == ej.Status.REJECTED).all()
    np.testing.assert_array_equal(trace.mean, 0)


@pytest.mark.parametrize(("dtype", "gap"), [(np.float32, 200.0), (np.float64, 2000.0)])
def test_information_after_a_gap_of_stable_motion_is_kalman(dtype, gap):
    stable = ej.linear_model(
        lambda p, a, b: jnp.exp(-0.5 * (b - a))[None, None],
        np.eye(1),
        0.1 * np.eye(1),
        lambda p, a, b: (1 - jnp.exp(-(b - a)))[None, None],
    )
    t = np.r_[np.arange(1.0, 6), gap + np.arange(1.0, 9)].astype(dtype)
    data = ej.stream(t, np.ones(t.size, dtype))
    prior = ej.Gaussian(jnp.zeros(1, dtype), jnp.eye(1, dtype=dtype))
    kalman, form, ewif = (
        ej.run(f, None, data, prior=prior, t0=0.0)
        for f in (ej.kalman(stable), ej.information(stable), ej.ewif(stable, 2.0))
    )
    np.testing.assert_allclose(form.mean, kalman.mean, atol=1e-5)
    # The weights of what was known underflow: what comes is a fresh start.
    later = jax.tree.map(lambda x: x[5:], data)
    fresh = ej.run(ej.ewif(stable, 2.0), None, later, prior=None, t0=t[5])
    assert np.isfinite(ewif.mean).all()
    np.testing.assert_allclose(ewif.mean[5:], fresh.mean, rtol=1e-5)


@pytest.mark.parametrize("dtype", [np.float32, pytest.param(np.float64, marks=pytest.mark.slow)])
def test_the_gradient_in_tau_is_finite_for_every_gap(dtype):
    filt = ej.ewif(walk(1.0), tau=lambda p: p)
    value = jnp.asarray([0.0, 1.1, 1.9, 3.05, 50.0, 51.2, 51.9, 53.1], dtype)

    def loss(tau, gap):
        late = jnp.asarray([0, 0, 0, 0, 1, 1, 1, 1], dtype)
        t = jnp.asarray([0, 1, 2, 3, 3, 4, 5, 6], dtype) + gap * late
        return ej.likelihood_loss(filt, ej.stream(t, value), prior=None, t0=0.0)(tau)

    gaps = jnp.asarray(np.geomspace(1e-3, 1e4, 60), dtype)
    tau = jnp.ones((), dtype)
    reverse = jax.jit(jax.vmap(jax.grad(loss), (None, 0)))(tau, gaps)
    forward = jax.jit(jax.vmap(jax.jacfwd(loss), (None, 0)))(tau, gaps)
    assert np.isfinite(reverse).all()
    np.testing.assert_allclose(forward, reverse, rtol=1e-2 if dtype is np.float32 else 1e-7)
    if dtype is np.float64:
        h = 1e-6
        both = jax.jit(jax.vmap(loss, (None, 0)))
        slope = (both(tau + h, gaps) - both(tau - h, gaps)) / (2 * h)
        np.testing.assert_allclose(reverse, slope, rtol=1e-4, atol=1e-5)


def test_the_rounding_of_a_zero_is_no_knowledge():
    """Motion over no time that is the identity but for rounding, and a sensor that does not see the
    first state: of the blocks of `run_parallel`, which know nothing at first, it was believed."""
    basis = np.array([[0.2, -0.9, 0.5], [1.3, 0.3, -0.1], [-0.4, 0.7, 1.1]])
    inverse, rates = np.linalg.inv(basis), np.array([-0.3, -0.1, -0.6])

    def F(params, a, b):
        return (basis * jnp.exp(rates * (b - a))[None]) @ inverse

    H = np.array([[0.0, 0.7, -1.1], [0.3, 2.7, 0.4]])
    R = np.array([[0.016, 0.001], [0.001, 0.002]])
    time, value = np.arange(0.5, 6.5, 0.5), np.random.default_rng(2).normal(size=(12, 2))
    prior = ej.Gaussian(np.ones(3), 50 * np.eye(3))
    model = ej.linear_model(F, H, R)
    trace = ej.run_parallel(model, None, ej.stream(time, value), tau=2.0, prior=prior, t0=0.0)

    def back(s):
        return (basis * np.exp(-rates * s)) @ inverse

    whiten = np.linalg.inv(np.linalg.cholesky(R))
    for k in (3, 4, 7, 11):
        now, half = time[k], lambda t, now=time[k]: np.exp((t - now) / 4)
        rows = [half(0.0) * back(now) / np.sqrt(50)]
        targets = [half(0.0) * np.ones(3) / np.sqrt(50)]
        for t, z in zip(time[: k + 1], value, strict=False):
            rows.append(half(t) * whiten @ H @ back(now - t))
            targets.append(half(t) * whiten @ z)
        right = np.linalg.lstsq(np.vstack(rows), np.concatenate(targets))[0]
        np.testing.assert_allclose(trace.mean[k], right, rtol=1e-9, atol=1e-9)
