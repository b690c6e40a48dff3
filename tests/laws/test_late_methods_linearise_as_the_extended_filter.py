"""Late data on a nonlinear model: a1, b1, al1, bl1 and asd against the equations by hand in NumPy.

The state is (r, s) with dr/dt = r (1 - r) and ds/dt = r: a flow in closed form that reverses.
"""

import jax.numpy as jnp
import numpy as np
import pytest

import ewif_jax as ej

NOISE = np.array([[0.02, 0.01], [0.01, 0.05]])
R = np.array([[0.04]])
MEAN, COV = np.array([0.6, 0.2]), np.array([[0.03, 0.01], [0.01, 0.08]])
NOW = [0.5, 1.1, 1.6]


def move(x, dt, xp=np):
    grown = 1 + x[0] * (xp.exp(dt) - 1)
    return xp.stack([x[0] * xp.exp(dt) / grown, x[1] + xp.log(grown)])


def moved_by(x, dt):
    """The derivative of `move`."""
    grown = 1 + x[0] * (np.exp(dt) - 1)
    return np.array([[np.exp(dt) / grown**2, 0.0], [(np.exp(dt) - 1) / grown, 1.0]])


def see(x, xp=np):
    return (x[0] * xp.cos(x[1]))[None]


def seen_by(x):
    return np.array([[np.cos(x[1]), -x[0] * np.sin(x[1])]])


MODEL = ej.Model(
    lambda p, x, t0, t1: move(x, t1 - t0, jnp),
    lambda p, t0, t1: jnp.abs(t1 - t0) * NOISE,
    lambda p, x, sensor, t: see(x, jnp),
    lambda p, sensor, t: jnp.asarray(R),
)


def kalman_update(x, P, z, predicted, cross, S):
    K = np.linalg.solve(S, cross.T).T
    return x + K @ (z - predicted), P - K @ S @ K.T


def in_sequence(values):
    """Times, means and covariances of the extended filter, beginning with the prior."""
    track = [(0.0, MEAN, COV)]
    for t, z in zip(NOW, values, strict=True):
        before, x, P = track[-1]
        F = moved_by(x, t - before)
        x, P = move(x, t - before), F @ P @ F.T + (t - before) * NOISE
        H = seen_by(x)
        x, P = kalman_update(x, P, z, see(x), P @ H.T, H @ P @ H.T + R)
        track.append((t, x, P))
    return track


def one_step(track, back, late, z, noise_estimated):
    """(9), (10) with (71)-(86), linearised: from the stored estimate `back` times ago."""
    (now, x, P), (start, x0, P0) = track[-1], track[-1 - back]
    F = moved_by(x0, now - start)
    M_inv = np.linalg.inv(F @ P0 @ F.T + (now - start) * NOISE)
    Q = (now - late) * NOISE
    P_xv = P @ M_inv @ Q
    if noise_estimated:
        v = Q @ M_inv @ (x - move(x0, now - start))
        P_vv = Q - Q @ (M_inv - M_inv @ P @ M_inv) @ Q
    else:
        v, P_vv = np.zeros(2), Q
    A, there = moved_by(x - v, late - now), move(x - v, late - now)
    H = seen_by(there)
    S = H @ A @ (P + P_vv - P_xv - P_xv.T) @ A.T @ H.T + R
    return kalman_update(x, P, z, see(there), (P - P_xv) @ A.T @ H.T, S)


def joint(values, late, z):
    """The joint Gaussian of the states at 0 and all `NOW`; then `z` of the one at `late`."""
    x, P = MEAN, COV
    times = [0.0]
    for t, value in zip([*NOW, late], [*values, z], strict=True):
        if t not in times:
            newest = x[-2:]
            F = moved_by(newest, t - times[-1])
            cross = F @ P[-2:]
            corner = cross[:, -2:] @ F.T + (t - times[-1]) * NOISE
            P = np.block([[P, cross.T], [cross, corner]])
            x = np.append(x, move(newest, t - times[-1]))
            times.append(t)
        at = 2 * times.index(t)
        H = np.zeros((1, x.size))
        H[:, at : at + 2] = seen_by(x[at : at + 2])
        x, P = kalman_update(x, P, value, see(x[at : at + 2]), P @ H.T, H @ P @ H.T + R)
    return x[-2:], P[-2:, -2:]


VALUES = np.array([[0.55], [0.35], [-0.1]])


def last(method, late, z):
    data = ej.stream(np.array([*NOW, late]), np.concatenate([VALUES, z[None]]))
    prior = ej.Gaussian(jnp.asarray(MEAN), jnp.asarray(COV))
    trace = ej.run(method, None, data, prior=prior, t0=0.0)
    assert trace.info.status[-1] == ej.Status.LATE_USED
    return trace.mean[-1], trace.cov[-1]


@pytest.mark.parametrize(
    ("name", "build", "back", "noise_estimated"),
    [
        ("a1", ej.a1, 1, True),
        ("b1", ej.b1, 1, False),
        ("al1", lambda model: ej.al1(model, 3), 2, True),
        ("bl1", lambda model: ej.bl1(model, 3), 2, False),
    ],
)
def test_the_one_step_methods(name, build, back, noise_estimated):
    late, z = (1.3 if back == 1 else 0.8), np.array([0.7])
    expected = one_step(in_sequence(VALUES), back, late, z, noise_estimated)
    mean, cov = last(build(MODEL), late, z)
    np.testing.assert_allclose(mean, expected[0], rtol=1e-9)
    np.testing.assert_allclose(cov, expected[1], rtol=1e-8, atol=1e-12)
    assert np.abs(np.asarray(mean) - in_sequence(VALUES)[-1][1]).max() > 1e-3


@pytest.mark.parametrize("late", [0.5, 1.1])
def test_asd(late):
    """A late measurement is linearised at the estimate of its own time, given all until then."""
    z = np.array([0.7])
    expected = joint(VALUES, late, z)
    mean, cov = last(ej.asd(MODEL, 3), late, z)
    np.testing.assert_allclose(mean, expected[0], rtol=1e-9)
    np.testing.assert_allclose(cov, expected[1], rtol=1e-8, atol=1e-12)
