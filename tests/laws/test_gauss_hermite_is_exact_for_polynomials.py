"""The Gauss-Hermite filter's moments are those of its polynomials, and of a loop over its grid."""

from itertools import product
from math import factorial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import ewif_jax as ej
from laws.cases import case, close, model

MEAN = np.array([0.3, -0.4])
ROOT = np.array([[0.8, 0.0], [-0.3, 0.5]])
PRIOR = ej.Gaussian(MEAN, ROOT @ ROOT.T)
NOISE = 0.2


def seeing(observe, moving=lambda x, dt: x, angle=False):
    """A model of two states with one sensor of one component."""

    def residual(value, predicted, sensor):
        return jnp.arctan2(jnp.sin(value - predicted), jnp.cos(value - predicted))

    made = ej.Model(
        lambda p, x, t0, t1: moving(x, t1 - t0),
        lambda p, t0, t1: 0.1 * jnp.abs(t1 - t0) * jnp.eye(2),
        lambda p, x, s, t: jnp.stack([observe(x)]),
        lambda p, s, t: jnp.full((1, 1), NOISE),
    )
    return made._replace(residual=residual) if angle else made


def hermite(observe, order, prior=PRIOR):
    """Predicted value and its covariance without noise, at the prior."""
    filtered = ej.unscented(seeing(observe), points="gauss-hermite", order=order)
    z = ej.stream(np.zeros(1), np.zeros((1, 1)))
    info = ej.run(filtered, None, z, prior=prior, t0=0.0).info
    return -info.innovation[0, 0], info.innovation_cov[0, 0, 0] - NOISE


def normal_moment(k):
    return 0 if k % 2 else factorial(k) / (2 ** (k // 2) * factorial(k // 2))


def expected_power(i, j):
    """E[u^i w^j] of two independent normal numbers with means 0.3 and -0.4, spreads 0.8, 0.5."""

    def power(k, mean, std):
        choose = [factorial(k) / factorial(a) / factorial(k - a) for a in range(k + 1)]
        return sum(c * mean ** (k - a) * std**a * normal_moment(a) for a, c in enumerate(choose))

    return power(i, 0.3, 0.8) * power(j, -0.4, 0.5)


STRAIGHT = ej.Gaussian(MEAN, np.diag([0.64, 0.25]))


@pytest.mark.parametrize("order", [2, 3, 5])
def test_means_of_degree_2p_minus_1_are_exact_and_no_further(order):
    most = 2 * order - 1
    found, _ = hermite(lambda x: x[0] ** most * x[1] ** (most - 1), order, STRAIGHT)
    np.testing.assert_allclose(found, expected_power(most, most - 1), rtol=1e-12)
    beyond, _ = hermite(lambda x: x[0] ** (most + 1), order, STRAIGHT)
    assert abs(beyond / expected_power(most + 1, 0) - 1) > 1e-3


def test_covariances_of_half_the_degree_are_exact():
    """Of a square, with the correlation of the standard prior: 2 tr(A P A P) + 4 m' A P A m."""
    A = np.array([[1.0, 0.4], [0.4, -0.5]])
    found, spread = hermite(lambda x: x @ A @ x, 3)
    P = PRIOR.cov
    np.testing.assert_allclose(found, MEAN @ A @ MEAN + np.trace(A @ P), rtol=1e-12)
    right = 2 * np.trace(A @ P @ A @ P) + 4 * MEAN @ A @ P @ A @ MEAN
    np.testing.assert_allclose(spread, right, rtol=1e-12)
    assert abs(hermite(lambda x: x @ A @ x, 2)[1] / right - 1) > 1e-3


def swung(xp, x, dt):
    return xp.stack([x[0] + dt * xp.sin(x[1]), x[1] - 0.3 * dt * x[0] ** 2])


def angle_of(xp, x):
    return xp.arctan2(x[1], x[0] - 0.9)


WORLD = seeing(lambda x: angle_of(jnp, x), lambda x, dt: swung(jnp, x, dt), angle=True)
TIMES = np.array([0.3, 0.8, 0.8, 1.4])
VALUES = np.array([3.0, -3.1, -2.8, 3.1])


def grid_moments(f, x, P, order, apart):
    nodes, weights = np.polynomial.hermite.hermgauss(order)
    L, middle = np.linalg.cholesky(P), f(x)
    points = [x + np.sqrt(2) * L @ np.array(node) for node in product(nodes, repeat=2)]
    w = np.array([np.prod(pair) for pair in product(weights, repeat=2)]) / np.pi
    off = np.array([apart(f(point), middle) for point in points])
    shift = w @ off
    d, e = off - shift, np.array(points) - x
    return middle + shift, (w[:, None] * d).T @ d, (w[:, None] * e).T @ d


def wrapped(a, b):
    return np.angle(np.exp(1j * (a - b)))


def loop(order):
    x, P, last, found = MEAN, PRIOR.cov, 0.0, []
    for t, z in zip(TIMES, VALUES, strict=True):
        dt, last = t - last, t
        if dt:
            x, P, _ = grid_moments(lambda y, dt=dt: swung(np, y, dt), x, P, order, np.subtract)
            P = P + 0.1 * dt * np.eye(2)
        see = lambda y: np.array([angle_of(np, y)])  # noqa: E731
        y, S, C = grid_moments(see, x, P, order, wrapped)
        K = C / (S + NOISE)
        x, P = x + K @ wrapped(np.array([z]), y), P - K @ (S + NOISE) @ K.T
        found.append((x, P))
    return found


STREAM = ej.stream(TIMES, VALUES[:, None])


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_the_filter_is_a_loop_over_its_grid(dtype):
    """Angles on both sides of the cut included."""
    filtered = ej.unscented(WORLD, points="gauss-hermite", order=4)
    stream = jax.tree.map(lambda x: x.astype(dtype) if x.dtype == float else x, STREAM)
    prior = ej.Gaussian(*(x.astype(dtype) for x in PRIOR))
    trace = ej.run(filtered, None, stream, prior=prior, t0=np.asarray(0.0, dtype))
    assert trace.mean.dtype == dtype
    tolerance = {np.float32: 1e-4, np.float64: 1e-10}[dtype]
    close(trace.mean, [x for x, _ in loop(4)], tolerance)
    close(trace.cov, [P for _, P in loop(4)], tolerance)


def test_a_batch_is_its_runs_and_the_gradient_is_the_quotient():
    filtered = ej.unscented(WORLD, points="gauss-hermite")
    streams = [STREAM._replace(value=STREAM.value + shift) for shift in (0.0, 0.3)]
    both = jax.tree.map(lambda *x: jnp.stack(x), *streams)
    batch = ej.run_batch(filtered, None, both, prior=PRIOR, t0=0.0)

    def mean_of(spread, stream=STREAM):
        prior = ej.Gaussian(PRIOR.mean, spread * PRIOR.cov)
        return ej.run(filtered, None, stream, prior=prior, t0=0.0).mean

    for k, stream in enumerate(streams):
        close(batch.mean[k], mean_of(1.0, stream), 1e-12)
    last = jax.jit(lambda spread: mean_of(spread)[-1, 0])
    slope = jax.jit(jax.grad(lambda spread: mean_of(spread)[-1, 0]))(1.0)
    np.testing.assert_allclose(slope, (last(1 + 1e-6) - last(1 - 1e-6)) / 2e-6, rtol=1e-7)


def test_of_a_linear_model_it_is_kalman():
    world = case(14, 3)
    functions = ej.Model(
        model().transition, model().process_cov, model().observe, model().measurement_cov
    )
    options = {"prior": world.prior, "t0": 0.0}
    expected = ej.run(ej.kalman(model()), world.params, world.stream(), **options)
    filtered = ej.unscented(functions, points="gauss-hermite", order=2)
    found = ej.run(filtered, world.params, world.stream(), **options)
    for a, b in ((found.mean, expected.mean), (found.cov, expected.cov)):
        close(a, b, 1e-10)
    close(found.info.log_likelihood, expected.info.log_likelihood, 1e-10)


def test_of_one_state_order_three_is_kappa_two():
    bent = ej.Model(
        lambda p, x, t0, t1: x + (t1 - t0) * jnp.sin(x),
        lambda p, t0, t1: 0.1 * jnp.abs(t1 - t0) * jnp.ones((1, 1)),
        lambda p, x, s, t: jnp.exp(0.5 * x),
        lambda p, s, t: jnp.full((1, 1), NOISE),
    )
    prior = ej.Gaussian(np.array([0.4]), np.array([[0.7]]))
    stream = ej.stream(TIMES, np.array([[1.2], [0.7], [2.0], [1.1]]))
    filters = ej.unscented(bent, points="gauss-hermite"), ej.unscented(bent, ut_kappa=2.0)
    a, b = (ej.run(x, None, stream, prior=prior, t0=0.0) for x in filters)
    for x, y in ((a.mean, b.mean), (a.cov, b.cov), (a.info[:3], b.info[:3])):
        jax.tree.map(lambda x, y: close(x, y, 1e-12), x, y)


def test_what_cannot_be_is_refused():
    with pytest.raises(ValueError, match="order: expected a whole number >= 2"):
        ej.unscented(WORLD, points="gauss-hermite", order=1)
    with pytest.raises(ValueError, match="points: expected 'unscented' or 'gauss-hermite'"):
        ej.unscented(WORLD, points="cubature")
    with pytest.raises(ValueError, match="order: expected nothing unless"):
        ej.unscented(WORLD, order=3)
    with pytest.raises(ValueError, match="ut_alpha: expected no settings"):
        ej.unscented(WORLD, ut_kappa=2.0, points="gauss-hermite")
    wide = ej.Gaussian(np.zeros(12), np.eye(12))
    with pytest.raises(ValueError, match=r"order: expected at most 20000 .* got 3, 531441 points"):
        ej.unscented(WORLD, points="gauss-hermite").init(None, wide, 0.0)
