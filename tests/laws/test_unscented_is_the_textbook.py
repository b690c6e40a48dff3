"""The unscented filter and smoother equal a loop over points, angles and refusals included."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles.unscented import unscented_smoother

import ewif_jax as ej
from ewif_jax.estimators.unscented import unscented
from ewif_jax.kernels import symmetric
from ewif_jax.models import bearing_sensor, constant_velocity, position_sensor
from ewif_jax.recursions.sigma_points import SigmaPoints, flow_around, measure_around
from ewif_jax.smoothers.rts import rts

SETTINGS = {"ut_alpha": 0.7, "ut_beta": 2.0, "ut_kappa": 1.0}
POSITIONS = ((6.0, 0.3), (-1.0, 4.0))
DRAG, DENSITY, NOISE = 0.15, 0.2, 2e-2
PRIOR = ej.Gaussian(np.array([1.0, 0.5, -0.8, 0.1]), np.diag([0.5, 0.4, 0.1, 0.1]))


def _linear(q=DENSITY, r=NOISE):
    return constant_velocity(sensors=[bearing_sensor(r, p) for p in POSITIONS], dims=2, q=q)


def drag_model():
    """Two bearings of a body that is slowed down by the square of its speed."""
    linear = _linear(lambda p: p["q"], lambda p: p["r"])

    def transition(params, x, t0, t1):
        speed = jnp.sqrt(x[2] ** 2 + x[3] ** 2 + 1e-6)
        slowed = jnp.concatenate([x[:2], x[2:] / (1 + DRAG * speed * (t1 - t0))])
        return linear.transition(params, slowed, t0, t1)

    return linear._replace(transition=transition, linear=None)


MODEL = drag_model()
PARAMS = {"q": DENSITY, "r": NOISE}
TIMES = np.array([0.4, 1.0, 1.0, 1.7, 2.5, 3.1])
SENSORS = np.array([0, 1, 0, 0, 1, 0])
VALUES = np.array([-3.05, -1.1, 3.1, -3.1, -1.3, 3.0])[:, None] * np.array([1.0])
STREAM = ej.stream(TIMES, VALUES, SENSORS)


def move(x, t0, t1):
    dt = t1 - t0
    v = x[2:] / (1 + DRAG * np.sqrt(x[2] ** 2 + x[3] ** 2 + 1e-6) * dt)
    return np.concatenate([x[:2] + dt * v, v])


def Q(t0, t1):
    dt = t1 - t0
    return DENSITY * np.kron([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]], np.eye(2))


def see(x, sensor):
    return [np.arctan2(x[1] - POSITIONS[sensor][1], x[0] - POSITIONS[sensor][0])]


def wrapped(a, b):
    return np.angle(np.exp(1j * (a - b)))


def expected():
    return unscented_smoother(
        move,
        Q,
        see,
        [[NOISE]],
        wrapped,
        t0=0.0,
        mean=PRIOR.mean,
        cov=PRIOR.cov,
        times=TIMES,
        values=VALUES,
        sensors=SENSORS,
        settings=tuple(SETTINGS.values()),
    )


def test_the_filter():
    """Sensor 0 looks along -x: predicted bearings lie on both sides of the cut."""
    trace = ej.run(unscented(MODEL, **SETTINGS), PARAMS, STREAM, prior=PRIOR, t0=0.0)
    for k, (mean, cov) in enumerate(expected()[0]):
        np.testing.assert_allclose(trace.mean[k], mean, atol=1e-10)
        np.testing.assert_allclose(trace.cov[k], cov, atol=1e-10)
    assert np.abs(trace.info.innovation).max() < 1.5


def test_the_smoother():
    smoothed = rts(MODEL, PARAMS, STREAM, prior=PRIOR, t0=0.0, form="unscented", **SETTINGS)
    for k, (mean, cov) in enumerate(expected()[1]):
        np.testing.assert_allclose(smoothed.mean[k], mean, atol=1e-9)
        np.testing.assert_allclose(smoothed.cov[k], cov, atol=1e-9)


def test_gradients_are_finite_differences():
    estimator = unscented(MODEL, ut_alpha=lambda p: p["ut_alpha"], ut_beta=2.0)
    at = {**PARAMS, "ut_alpha": 0.9}

    @jax.jit
    def loss(params):
        trace = ej.run(estimator, params, STREAM, prior=PRIOR, t0=0.0)
        return jnp.sum(trace.mean**2) + jnp.sum(trace.cov) + jnp.sum(trace.info.log_likelihood)

    slope = jax.jit(jax.grad(loss))(at)
    for name, value in at.items():
        h = 1e-5 * value
        difference = (loss({**at, name: value + h}) - loss({**at, name: value - h})) / (2 * h)
        np.testing.assert_allclose(slope[name], difference, rtol=1e-5, atol=1e-7)


def one(dtype, **settings):
    plane = constant_velocity(sensors=position_sensor(1.0))
    prior = ej.Gaussian(np.zeros(2, dtype), np.eye(2, dtype=dtype))
    seen = ej.stream(np.ones(1, dtype), np.ones(1, dtype))
    return ej.run(unscented(plane, **settings), None, seen, prior=prior, t0=0.0)


def test_points_that_single_precision_cannot_tell_apart_are_refused():
    with pytest.raises(ValueError, match=r"ut_alpha: expected sigma points far enough .*float32"):
        one(np.float32, ut_alpha=1e-3)
    assert np.isfinite(one(np.float64, ut_alpha=1e-3).mean).all()
    assert one(np.float32).mean.dtype == np.float32


@pytest.mark.parametrize(
    ("settings", "name"),
    [
        ({"ut_alpha": 0.0}, "ut_alpha"),
        ({"ut_kappa": -2.0}, "ut_kappa"),
        ({"ut_beta": np.nan}, "ut_beta"),
    ],
)
def test_bad_settings_are_named(settings, name):
    with pytest.raises(ValueError, match=f"{name}: expected"):
        one(np.float64, **settings)


def test_an_unknown_smoother_is_refused():
    with pytest.raises(ValueError, match=r"form: expected one of .*'particle'"):
        rts(MODEL, PARAMS, STREAM, prior=PRIOR, t0=0.0, form="particle")


def beside_what_stands_still(model):
    """The model of a state (2n,) whose second half neither moves nor is seen."""

    def transition(params, x, t0, t1):
        return jnp.concatenate([model.transition(params, x[:4], t0, t1), x[4:]])

    def process_cov(params, t0, t1):
        return jnp.pad(model.process_cov(params, t0, t1), (0, 4))

    def observe(params, x, sensor, t):
        return model.observe(params, x[:4], sensor, t)

    return model._replace(transition=transition, process_cov=process_cov, observe=observe)


@pytest.mark.parametrize("points", [SigmaPoints(), SigmaPoints(0.7, 2.0, 1.0), None])
def test_no_points_are_needed_for_what_stands_still(points):
    """Moments of the half that moves are those of all 4n points of the whole."""
    rng = np.random.default_rng(4)
    root = rng.normal(size=(8, 8))
    mean, cov = jnp.asarray(rng.normal(size=8)), symmetric.pack(jnp.asarray(root @ root.T))
    whole = beside_what_stands_still(MODEL)
    flow = jax.jit(flow_around, static_argnums=(0, 1, 7))
    moved, F, Q = flow(MODEL, points, PARAMS, mean, cov, 0.3, 1.5, 4)
    moved_8, F_8, Q_8 = flow(whole, points, PARAMS, mean, cov, 0.3, 1.5)
    np.testing.assert_allclose(moved, moved_8[:4], rtol=1e-10)
    np.testing.assert_allclose(np.kron([[1, 0], [0, 0]], F) + np.diag([0.0] * 4 + [1] * 4), F_8,
                               rtol=1e-9, atol=1e-9)  # fmt: skip
    np.testing.assert_allclose(np.kron([[1, 0], [0, 0]], Q), Q_8, rtol=1e-9, atol=1e-9)
    seen = jax.tree.map(lambda x: x[0], STREAM)
    measure = jax.jit(measure_around, static_argnums=(0, 1, 6))
    found = measure(MODEL, points, PARAMS, mean, cov, seen, 4)
    wanted = measure(whole, points, PARAMS, mean, cov, seen)
    jax.tree.map(partial(np.testing.assert_allclose, rtol=1e-9, atol=1e-9), found, wanted)
