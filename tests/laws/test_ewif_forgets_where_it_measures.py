"""Directional forgetting: what a measurement sees is forgotten, and nothing else ever is."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import ewif_jax as ej
from laws.cases import case, close, model

TAU = 1.3


def tau_of(params):
    return params["tau"]


STILL = ej.linear_model(
    lambda p, t0, t1: jnp.eye(3) + 0 * (t1 - t0),
    lambda p, s, t: jnp.asarray(p["H"])[s],
    lambda p, s, t: jnp.asarray(p["R"])[s],
)
"""Three numbers that stand still, in whose sum of squares the directions have equal units."""
DIRECTIONAL = ej.ewif(STILL, tau_of, directional=True)
PLAIN = ej.ewif(STILL, tau_of)
PARAMS = {
    "tau": TAU,
    "H": np.array([[[1.0, 0.0, 0.0], [0.3, 0.8, 0.0]], [[0.5, -0.5, 0.2], [1.0, 0.2, -0.7]]]),
    "R": np.array([[[0.4, 0.1], [0.1, 0.3]], [[0.2, 0.0], [0.0, 0.5]]]),
}
MEAN = np.array([0.3, -1.0, 0.5])
COV = np.array([[1.0, 0.3, 0.1], [0.3, 0.6, -0.2], [0.1, -0.2, 0.8]])
PRIOR = ej.Gaussian(MEAN, COV)
TIMES = np.array([0.4, 0.9, 0.9, 1.7, 2.0, 3.1])
SENSORS = np.array([0, 1, 0, 1, 1, 0])
MASKS = np.array([[1, 1], [1, 0], [0, 1], [1, 1], [0, 1], [1, 1]], bool)
VALUES = np.random.default_rng(3).normal(size=(6, 2))
STREAM = ej.Measurement(
    jnp.asarray(TIMES), jnp.asarray(VALUES), jnp.asarray(SENSORS, jnp.int32), jnp.asarray(MASKS)
)


def run(estimator, stream, params=PARAMS, prior=PRIOR):
    return ej.run(estimator, params, stream, prior=prior, t0=0.0)


def loop(tau=TAU):
    """The information matrix of Lai & Bernstein with an age for each direction, in NumPy."""
    x, J, A, last, found = MEAN, np.linalg.inv(COV), np.zeros((3, 3)), 0.0, []
    for t, z, s, mask in zip(TIMES, VALUES, SENSORS, MASKS, strict=True):
        A, last = A + (t - last) * np.eye(3), t
        H, R = PARAMS["H"][s][mask], PARAMS["R"][s][np.ix_(mask, mask)]
        V = np.linalg.qr(H.T)[0].T
        V = V * np.sign(np.sum(V * H, 1))[:, None]
        ages = np.zeros((len(V), len(V)))
        left = A
        for k, v in enumerate(V):
            ages[k, k] = v @ left @ v
            if ages[k, k] > 1e-12:
                left = left - np.outer(left @ v, left @ v) / ages[k, k]
        A = left
        E = np.sqrt(np.expm1(ages.clip(0) / tau))
        P = np.linalg.inv(J) + V.T @ E @ np.linalg.inv(V @ J @ V.T) @ E @ V
        S = H @ P @ H.T + R
        K = P @ H.T @ np.linalg.inv(S)
        x, P = x + K @ (z[mask] - H @ x), P - K @ S @ K.T
        J = np.linalg.inv(P)
        found.append((x, P))
    return found


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_it_is_the_information_matrix_of_lai_and_bernstein(dtype):
    """Missing components, and two measurements at one time, of which the second sees a direction
    that the first has seen in part."""
    stream = jax.tree.map(lambda x: x.astype(dtype) if x.dtype == float else x, STREAM)
    prior = ej.Gaussian(*(x.astype(dtype) for x in PRIOR))
    trace = ej.run(DIRECTIONAL, PARAMS, stream, prior=prior, t0=dtype(0))
    assert trace.mean.dtype == dtype
    tolerance = {np.float32: 1e-4, np.float64: 1e-9}[dtype]
    close(trace.mean, [x for x, _ in loop()], tolerance)
    close(trace.cov, [P for _, P in loop()], tolerance)


def test_with_one_age_it_is_their_formula():
    """I+ = J - (1 - w) J V'(V J V')^-1 V J, at the first measurement, where all ages are equal."""
    H, R, J = PARAMS["H"][1], PARAMS["R"][1], np.linalg.inv(COV)
    w = np.exp(-0.5 / TAU)
    left = J - (1 - w) * J @ H.T @ np.linalg.inv(H @ J @ H.T) @ H @ J
    expected = np.linalg.inv(left + H.T @ np.linalg.inv(R) @ H)
    seen = ej.stream(np.array([0.5]), np.zeros((1, 2)), np.array([1]))
    close(run(DIRECTIONAL, seen).cov[0], expected, 1e-11)


@pytest.mark.parametrize("known", [True, False])
def test_where_every_direction_is_seen_it_is_ewif(known):
    """In a world that moves, with late measurements, from a prior and from nothing."""
    world = case(4, 2)
    order = np.array([0, 2, 1, 3, 5, 4, 6, 9, 7, 8])
    stream = world.stream(order)._replace(mask=jnp.ones((10, 2), bool))
    prior = world.prior if known else None
    both = ej.ewif(model(), tau_of), ej.ewif(model(), tau_of, directional=True)
    expected, found = (ej.run(x, world.params, stream, prior=prior, t0=0.0) for x in both)
    for a, b in ((found.mean, expected.mean), (found.cov, expected.cov)):
        close(a, b, 1e-9)
    close(found.info.log_likelihood, expected.info.log_likelihood, 1e-9)
    np.testing.assert_array_equal(found.info.status, expected.info.status)


def only(component, times):
    """A stream that sees one of the three numbers."""
    H = np.zeros((1, 1, 3))
    H[0, 0, component] = 2.0
    params = {"tau": TAU, "H": H, "R": np.full((1, 1, 1), 0.4)}
    return params, ej.stream(times, np.sin(times)[:, None])


def test_a_direction_never_seen_keeps_its_prior():
    """Which EWIF forgets."""
    params, stream = only(0, np.arange(1.0, 41.0))
    prior = ej.Gaussian(MEAN, np.diag([1.0, 0.6, 0.8]))
    found = run(DIRECTIONAL, stream, params, prior)
    close(found.mean[-1, 1:], MEAN[1:], 1e-13)
    close(found.cov[-1, 1:, 1:], np.diag([0.6, 0.8]), 1e-13)
    plain = run(PLAIN, stream, params, prior)
    close(found.mean[:, 0], plain.mean[:, 0], 1e-11)
    close(found.cov[:, 0, 0], plain.cov[:, 0, 0], 1e-11)
    assert plain.cov[-1, 1, 1] > 1e10


def test_numbers_that_are_seen_at_times_of_their_own_are_each_an_ewif():
    """Each is forgotten over the time since it was itself seen last."""
    times = np.array([0.5, 0.8, 1.4, 1.5, 2.6, 3.0])
    sensors = np.array([0, 1, 0, 0, 1, 1])
    H, values = np.eye(3)[:2, None], np.cos(3 * times)
    params = {"tau": TAU, "H": H, "R": np.full((2, 1, 1), 0.4)}
    prior = ej.Gaussian(MEAN, np.diag([1.0, 0.6, 0.8]))
    found = run(DIRECTIONAL, ej.stream(times, values[:, None], sensors), params, prior)
    for k in (0, 1):
        own = np.flatnonzero(sensors == k)
        alone = ej.stream(times[own], values[own, None], np.full(len(own), k))
        expected = run(PLAIN, alone, params, prior)
        close(found.mean[own, k], expected.mean[:, k], 1e-11)
        close(found.cov[own, k, k], expected.cov[:, k, k], 1e-11)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_a_gap_loses_nothing(dtype):
    """Of a thousand tau, over which EWIF forgets everything: what is seen after it is new, the rest
    is as it was."""
    params, stream = only(0, np.array([0.5, 1300.0]).astype(dtype))
    stream = stream._replace(value=stream.value.astype(dtype))
    prior = ej.Gaussian(*(x.astype(dtype) for x in (MEAN, np.diag([1.0, 0.6, 0.8]))))
    found = ej.run(DIRECTIONAL, params, stream, prior=prior, t0=dtype(0))
    close(found.cov[1], np.diag([0.1, 0.6, 0.8]), 1e-5)
    close(found.mean[1], [np.sin(1300.0) / 2, *MEAN[1:]], 1e-3)
    nothing = stream._replace(mask=jnp.zeros((2, 1), bool))
    close(ej.run(DIRECTIONAL, params, nothing, prior=prior, t0=dtype(0)).cov[1], prior.cov, 1e-6)
    plain = ej.run(PLAIN, params, stream, prior=prior, t0=dtype(0))
    assert np.isnan(plain.mean[1]).all()


def test_eigenvalues_stay_within_bounds_without_excitation():
    """b >= P >= a with b the larger of the prior's variance and r / |h|^2, and a the smaller of
    it and (1 - w) r / |h|^2 (the proof is in docs/decisions/estimators.md); all directions lie in a
    plane. EWIF goes beyond b in the third, and a filter that forgets nothing beyond a."""
    rng = np.random.default_rng(0)
    across = np.array([0.5, -0.6, 0.6245])
    H = rng.normal(size=(60, 1, 3))
    H -= (H @ across / (across @ across))[..., None] * across
    params = {"tau": TAU, "H": H, "R": np.full((60, 1, 1), 0.4)}
    stream = ej.stream(0.25 * np.arange(1.0, 61.0), rng.normal(size=(60, 1)), np.arange(60))
    length = np.sum(H**2, -1)
    prior = np.linalg.eigvalsh(COV)
    most = max(prior.max(), 0.4 / length.min())
    least = min(prior.min(), (1 - np.exp(-0.25 / TAU)) * 0.4 / length.max())
    found = np.linalg.eigvalsh(run(DIRECTIONAL, stream, params).cov)
    assert found.max() <= most
    assert found.min() >= least
    without = run(DIRECTIONAL, stream, {**params, "tau": 1e9})
    assert np.linalg.eigvalsh(without.cov).min() < least
    assert np.linalg.eigvalsh(run(PLAIN, stream, params).cov).max() > 10 * most


def test_how_much_the_order_matters():
    """Not at all without forgetting in between (an endless tau), and by 0.6 of a standard deviation
    here, where half of the measurements come late."""
    late = jax.tree.map(lambda x: x[np.array([1, 0, 4, 3, 5, 2])], STREAM)

    def apart(tau):
        params = {**PARAMS, "tau": tau}
        first, other = (run(DIRECTIONAL, x, params) for x in (STREAM, late))
        return np.abs((other.mean - first.mean)[-1] / np.sqrt(np.diag(first.cov[-1]))).max()

    assert apart(1e9) < 1e-6
    assert 0.5 < apart(TAU) < 0.7


def test_of_functions_it_is_as_of_matrices():
    """With lines for a nonlinear model: here one that is linear."""
    functions = STILL._replace(linear=None)
    built = ej.ewif(functions, tau_of, linearisation="sigma-points", directional=True)
    expected, found = run(DIRECTIONAL, STREAM), run(built, STREAM)
    close(found.mean, expected.mean, 1e-9)
    close(found.cov, expected.cov, 1e-9)


PAIR = ej.linear_model(
    lambda p, t0, t1: jnp.eye(2) + 0 * (t1 - t0),
    lambda p, s, t: jnp.asarray([[[1.0, 0.4]], [[-0.2, 1.0]]])[s],
    lambda p, s, t: jnp.full((1, 1), 0.3, t.dtype),
)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_gradients_are_quotients_and_finite_in_a_gap(dtype):
    built = ej.ewif(PAIR, tau_of, directional=True)
    prior = ej.Gaussian(*(x[..., :2].astype(dtype) for x in (MEAN, COV[:2])))

    def loss(tau, stretch):
        times = stretch * jnp.asarray([0.4, 0.9, 0.6, 1.7], dtype)
        seen = ej.Measurement(
            times, jnp.ones((4, 1), dtype), jnp.array([0, 1, 1, 0]), jnp.ones((4, 1), bool)
        )
        trace = ej.run(built, {"tau": tau}, seen, prior=prior, t0=dtype(0))
        return jnp.sum(trace.mean**2) + jnp.sum(trace.cov) + jnp.sum(trace.info.log_likelihood)

    both = jax.jit(jax.value_and_grad(loss))
    assert np.isfinite(both(dtype(TAU), dtype(1e4))[1])
    slope = both(dtype(TAU), dtype(1))[1]
    assert np.isfinite(slope)
    if dtype == np.float64:
        up, down = (both(TAU * (1 + h), 1.0)[0] for h in (1e-6, -1e-6))
        np.testing.assert_allclose(slope, (up - down) / (2e-6 * TAU), rtol=1e-6)


def test_what_only_motion_makes_visible_is_never_forgotten():
    """Of positions alone, the variance of a velocity goes on falling; that of EWIF stays."""
    line = ej.models.constant_velocity(sensors=ej.models.position_sensor(0.5), q=0.0)
    data = ej.stream(np.arange(1.0, 65.0), np.zeros((64, 1)))
    options = {"prior": ej.Gaussian(np.zeros(2), np.eye(2)), "t0": 0.0}
    variances = [
        ej.run(ej.ewif(line, 2.0, directional=way), None, data, **options).cov[:, 1, 1]
        for way in (True, False)
    ]
    assert variances[0][63] < 0.6 * variances[0][31]
    np.testing.assert_allclose(variances[1][63], variances[1][31], rtol=1e-3)


def test_what_cannot_be_is_refused():
    with pytest.raises(ValueError, match="directional: expected a `tau`"):
        ej.ewif(STILL, weight=lambda p, t, now: jnp.exp(t - now), directional=True)
