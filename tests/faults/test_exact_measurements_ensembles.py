"""Exact measurements (R zero or singular): ensembles tend to Kalman's limit, particles refuse."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import ewif_jax as ej

TIMES = np.array([0.0, 1.0, 2.0, 2.0])
VALUES = np.array([[0.4, 0.2], [1.1, 0.7], [1.6, 0.1], [1.6, 0.1]])
"""The last one repeats the one before, of which an exact filter learns nothing."""
PRIOR = ej.Gaussian(np.zeros(2), np.eye(2))
FIRST, BOTH = np.array([True, False]), np.array([True, True])
CASES = {
    "no noise": (np.zeros((2, 2)), FIRST),
    "one exact component": (np.diag([0.0, 0.5]), BOTH),
    "rank one": (np.full((2, 2), 0.5), BOTH),
    "the whole state": (np.zeros((2, 2)), BOTH),
}
MEMBERS = 4000


def moved(dt):
    return np.array([[1.0, dt], [0.0, 1.0]])


def driven(dt):
    return 0.2 * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])


def model():
    """Position and velocity, both seen, with the noise that `params` say."""
    line = ej.models.constant_velocity(sensors=ej.models.position_sensor(1.0), q=0.2)

    def observe(params, x, sensor, t):
        return x

    def measurement_cov(params, sensor, t):
        return params["R"]

    return line._replace(observe=observe, measurement_cov=measurement_cov, linear=None)


MODEL = model()
ENSEMBLES = {
    "stochastic": ej.ensemble(MODEL, MEMBERS),
    "square_root": ej.ensemble(MODEL, MEMBERS, "square_root"),
    "enkf1": ej.enkf1(MODEL, MEMBERS, 2),
    "enkf2": ej.enkf2(MODEL, MEMBERS, 2, "shared"),
}
PARTICLES = {
    "bootstrap": ej.bootstrap(MODEL, 50),
    "pf_retrodict": ej.pf_retrodict(MODEL, 50),
    "pf_extended": ej.pf_extended(MODEL, 50, 2),
    "pf_fixed_point": ej.pf_fixed_point(MODEL, 50, 2),
}
LATE = {"bootstrap": ej.Status.TOO_LATE, "pf_fixed_point": ej.Status.LATE_USED}


@cache
def ran(name):
    """Compiled once for all cases."""
    method = {**ENSEMBLES, **PARTICLES}[name]

    def run(R, measurements):
        return ej.run(method, {"R": R}, measurements, prior=PRIOR, t0=0.0, key=jax.random.key(0))

    return jax.jit(run)


def stream(mask, values=VALUES, times=TIMES):
    rows = len(times)
    mask = np.tile(mask, (rows, 1))
    return jax.tree.map(jnp.asarray, ej.Measurement(times, values, np.zeros(rows, int), mask))


def limit(R, mask):
    """Kalman's recursion with pseudo-inverses, which pass over what is known already."""
    x, P, now = np.zeros(2), np.eye(2), 0.0
    H, R = np.eye(2)[mask], R[np.ix_(mask, mask)]
    for time, value in zip(TIMES, VALUES, strict=True):
        F = moved(time - now)
        x, P, now = F @ x, F @ P @ F.T + driven(time - now), time
        K = P @ H.T @ np.linalg.pinv(H @ P @ H.T + R, rcond=1e-12, hermitian=True)
        x, P = x + K @ (value[mask] - H @ x), P - K @ H @ P
    return x, P


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("name", ENSEMBLES)
def test_ensembles_tend_to_kalmans_limit(name, case):
    """What is exact is met to rounding, the rest as well as that many members can."""
    R, mask = CASES[case]
    trace = ran(name)(R, stream(mask))
    mean, cov = limit(R, mask)
    assert np.all(trace.info.status == ej.Status.USED)
    exact = np.diag(cov) < 1e-12
    np.testing.assert_allclose(trace.mean[-1][exact], mean[exact], atol=1e-12)
    np.testing.assert_allclose(trace.mean[-1], mean, atol=5 / np.sqrt(MEMBERS))
    np.testing.assert_allclose(trace.cov[-1], cov, atol=5 / np.sqrt(MEMBERS))
    # Nothing new: nothing moves but by the noise that a noisy component's members draw.
    if not np.any(R):
        np.testing.assert_allclose(trace.mean[-1], trace.mean[-2], atol=1e-12)
        np.testing.assert_allclose(trace.cov[-1], trace.cov[-2], atol=1e-12)


@pytest.mark.parametrize("name", ENSEMBLES)
def test_an_exact_measurement_against_an_exact_one_does_not_divide_by_rounding(name):
    """The ensemble stays where the first of them put it."""
    R, mask = CASES["no noise"]
    values = VALUES.copy()
    values[-1, 0] += 1.0
    trace = ran(name)(R, stream(mask, values))
    np.testing.assert_allclose(trace.mean[-1], trace.mean[-2], atol=1e-12)
    np.testing.assert_allclose(trace.cov[-1], trace.cov[-2], atol=1e-12)


@pytest.mark.parametrize("name", PARTICLES)
def test_particles_refuse_what_no_particle_can_meet(name):
    """In sequence and late. Given a particle now, the state then still has a density for the
    smoother of `pf_fixed_point`."""
    R, mask = CASES["one exact component"]
    late = np.array([0.0, 2.0, 1.0, 2.0])
    refused = ran(name)(R, stream(mask, times=late))
    expected = np.full(4, ej.Status.REJECTED)
    if name in LATE:
        expected[2] = LATE[name]
    np.testing.assert_array_equal(refused.info.status, expected)
    unused = expected != ej.Status.LATE_USED
    assert np.all(refused.info.log_likelihood[unused] == 0)
    np.testing.assert_array_equal(refused.mean[-1], refused.mean[-2])
    assert all(np.isfinite(x).all() for x in (refused.mean, refused.cov, *refused.info))
