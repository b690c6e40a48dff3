"""The extended smoother of a nonlinear model equals the textbook's recursion, inner states too."""

import jax.numpy as jnp
import numpy as np

import ewif_jax as ej
from ewif_jax.models import bearing_sensor, constant_velocity

POSITIONS = ((6.0, 0.3), (-1.0, 4.0))
DRAG, DENSITY, NOISE = 0.15, 0.2, 2e-2
TIMES = np.array([0.4, 1.0, 1.0, 1.7, 2.5, 3.1])
SENSORS = np.array([0, 1, 0, 0, 1, 0])
VALUES = np.array([-3.05, -1.1, 3.1, -3.1, -1.3, 3.0])
SEEN = np.array([True, True, True, False, True, True])
MEAN, COV = np.array([1.0, 0.5, -0.8, 0.1]), np.diag([0.5, 0.4, 0.1, 0.1])


def model():
    """Two bearings of a body that is slowed down by the square of its speed."""
    sensors = [bearing_sensor(NOISE, place) for place in POSITIONS]
    linear = constant_velocity(sensors=sensors, dims=2, q=DENSITY)

    def transition(params, x, t0, t1):
        slowed = x[2:] / (1 + DRAG * jnp.sqrt(x[2] ** 2 + x[3] ** 2) * (t1 - t0))
        return jnp.concatenate([x[:2] + (t1 - t0) * slowed, slowed])

    return linear._replace(transition=transition, linear=None)


def move(x, dt):
    """Where x goes, and the Jacobian by hand."""
    v = x[2:]
    speed = np.hypot(*v)
    slower = 1 + DRAG * speed * dt
    slope = np.eye(2) / slower - DRAG * dt * np.outer(v, v) / (speed * slower**2)
    F = np.block([[np.eye(2), dt * slope], [np.zeros((2, 2)), slope]])
    return np.concatenate([x[:2] + dt * v / slower, v / slower]), F


def noise(dt):
    return DENSITY * np.kron([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]], np.eye(2))


def look(x, sensor):
    """The bearing, and its Jacobian by hand."""
    east, north = x[:2] - POSITIONS[sensor]
    square = east**2 + north**2
    return np.arctan2(north, east), np.array([[-north / square, east / square, 0, 0]])


def textbook():
    """x(k|T) and P(k|T): a forward EKF, then x + G (x_s - x_p) and P + G (P_s - P_p) G'."""
    x, P, now, steps = MEAN, COV, 0.0, []
    for time, sensor, value, seen in zip(TIMES, SENSORS, VALUES, SEEN, strict=True):
        left = x, P
        x, F = move(x, time - now)
        P = F @ P @ F.T + noise(time - now)
        steps.append((*left, F, x, P))
        if seen:
            expected, H = look(x, sensor)
            K = P @ H.T / (H @ P @ H.T + NOISE)
            x = x + K[:, 0] * np.angle(np.exp(1j * (value - expected)))
            P = P - K @ H @ P
        now = time
    means, covs = [x], [P]
    for x, P, F, predicted, spread in steps[:0:-1]:
        G = P @ F.T @ np.linalg.inv(spread)
        means.insert(0, x + G @ (means[0] - predicted))
        covs.insert(0, P + G @ (covs[0] - spread) @ G.T)
    return np.array(means), np.array(covs)


def test_every_state():
    data = ej.stream(TIMES, VALUES[:, None], SENSORS, SEEN[:, None])
    found = ej.rts(model(), None, data, prior=ej.Gaussian(MEAN, COV), t0=0.0)
    means, covs = textbook()
    np.testing.assert_allclose(found.mean, means, atol=1e-10)
    np.testing.assert_allclose(found.cov, covs, atol=1e-10)
