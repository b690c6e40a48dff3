"""The models are what they say: exact discretisation, composition, reversal, inputs, sensors."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from laws.cases import close
from scipy.linalg import expm

import ewif_jax as ej
from ewif_jax.models import (
    affine_flow,
    bearing_sensor,
    constant_acceleration,
    constant_velocity,
    position_sensor,
    predict_measurement,
    predict_state,
    random_walk,
    wrap_angle,
)

SEEN = position_sensor(0.5)
KINEMATIC = {"random_walk": random_walk, "cv": constant_velocity, "ca": constant_acceleration}
ORDER = {"random_walk": 0, "cv": 1, "ca": 2}


def build(name, q=0.7, dims=1, **options):
    return KINEMATIC[name](sensors=position_sensor(0.5, dims), q=q, dims=dims, **options)


def F_of(model, t0, t1):
    return np.asarray(affine_flow(model, None, jnp.asarray(t0), jnp.asarray(t1), float)[0])


def Q_of(model, t0, t1):
    return np.asarray(model.process_cov(None, jnp.asarray(t0), jnp.asarray(t1)))


def van_loan(order, q, dt, dims=1):
    """F and Q of x' = G x + white noise of density q on the highest derivative."""
    n = order + 1
    G, noise = np.eye(n, k=1), np.zeros((n, n))
    noise[-1, -1] = q
    big = expm(np.block([[-G, noise], [np.zeros((n, n)), G.T]]) * dt)
    F = big[n:, n:].T
    return np.kron(F, np.eye(dims)), np.kron(F @ big[:n, n:], np.eye(dims))


@pytest.mark.parametrize("dims", [1, 2])
@pytest.mark.parametrize("name", KINEMATIC)
def test_exact_discretisation(name, dims):
    model = build(name, dims=dims)
    for dt in (0.0, 0.01, 0.7, 3.0):
        F, Q = van_loan(ORDER[name], 0.7, dt, dims)
        close(F_of(model, 1.2, 1.2 + dt), F, 1e-12)
        close(Q_of(model, 1.2, 1.2 + dt), Q, 1e-12)


@pytest.mark.parametrize("name", KINEMATIC)
@given(parts=st.lists(st.floats(0.0, 3.0), min_size=2, max_size=2))
def test_white_noise_composes_over_parts_of_an_interval(name, parts):
    a, b = parts
    model = build(name)
    F = F_of(model, a, a + b)
    close(Q_of(model, 0.0, a + b), F @ Q_of(model, 0.0, a) @ F.T + Q_of(model, a, a + b), 1e-10)
    close(F_of(model, 0.0, a + b), F @ F_of(model, 0.0, a), 1e-10)


def test_discrete_noise_is_the_published_one_and_does_not_compose():
    model = build("cv", noise="discrete")
    gamma = np.array([0.5**2 / 2, 0.5])
    close(Q_of(model, 1.0, 1.5), 0.7 * np.outer(gamma, gamma))
    F = F_of(model, 0.5, 1.0)
    twice = F @ Q_of(model, 0.0, 0.5) @ F.T + Q_of(model, 0.5, 1.0)
    assert np.abs(twice - Q_of(model, 0.0, 1.0)).max() > 0.01


def test_discrete_noise_of_the_acceleration_model_is_a_constant_jerk():
    model = build("ca", noise="discrete")
    gamma = np.array([0.5**3 / 6, 0.5**2 / 2, 0.5])
    close(Q_of(model, 0.0, 0.5), 0.7 * np.outer(gamma, gamma))


@pytest.mark.parametrize("name", KINEMATIC)
@given(t0=st.floats(-5, 5), t1=st.floats(-5, 5))
def test_motion_reverses_input_included(name, t0, t1):
    n = ORDER[name] + 1
    model = build(name, b=lambda p, t0, t1: jnp.sin(t1) * jnp.ones(n) - jnp.sin(t0) * jnp.ones(n))
    x = np.linspace(1.0, 2.0, n)
    there = model.transition(None, jnp.asarray(x), jnp.asarray(t0), jnp.asarray(t1))
    back = model.transition(None, there, jnp.asarray(t1), jnp.asarray(t0))
    np.testing.assert_allclose(back, x, atol=1e-9)
    np.testing.assert_allclose(F_of(model, t1, t0) @ F_of(model, t0, t1), np.eye(n), atol=1e-9)


def test_flow_and_sight_agree_with_the_functions_of_the_model():
    model = build("ca", dims=2, b=lambda p, t0, t1: (t1 - t0) * jnp.ones(6))
    x, t0, t1 = jnp.arange(6.0), jnp.asarray(0.2), jnp.asarray(0.9)
    moved, F, Q = predict_state(model, None, x, t0, t1)
    close(moved, model.transition(None, x, t0, t1))
    close(F, jax.jacfwd(lambda x: model.transition(None, x, t0, t1))(x))
    close(Q, model.process_cov(None, t0, t1))
    value, H, R = predict_measurement(model, None, x, jnp.int32(0), t1)
    close(value, x[:2])
    close(H, np.eye(2, 6))
    close(R, 0.5 * np.eye(2))


def test_a_nonlinear_flow_is_differentiated():
    model = ej.Model(
        lambda p, x, t0, t1: jnp.sin(x) * (t1 - t0),
        lambda p, t0, t1: jnp.zeros((2, 2)),
        lambda p, x, sensor, t: x[:1] ** 2,
        lambda p, sensor, t: jnp.eye(1),
    )
    x = jnp.asarray([0.3, 1.1])
    _, F, _ = predict_state(model, None, x, jnp.asarray(0.0), jnp.asarray(2.0))
    close(F, 2.0 * np.diag(np.cos(x)))
    _, H, _ = predict_measurement(model, None, x, jnp.int32(0), jnp.asarray(0.0))
    close(H, [[0.6, 0.0]])


def test_constants_speak_of_one_step():
    F, Q, b = np.array([[1.0, 0.1], [0.0, 0.9]]), np.diag([0.1, 0.2]), np.array([0.3, -0.4])
    model = ej.linear_model(F, np.eye(2), np.eye(2), Q, b)
    x = jnp.asarray([1.0, 2.0])

    def move(t0, t1):
        return model.transition(None, x, jnp.asarray(t0), jnp.asarray(t1))

    close(move(0.0, 5.0), F @ x + b)
    close(move(1.0, 1.0), x)
    close(model.transition(None, move(0.0, 1.0), jnp.asarray(1.0), jnp.asarray(0.0)), x)
    close(Q_of(model, 0.0, 3.0), Q)
    close(Q_of(model, 2.0, 2.0), np.zeros((2, 2)))


def test_a_singular_transition_runs_forward_and_is_nan_backward():
    model = ej.linear_model(np.diag([1.0, 0.0]), np.eye(2), np.eye(2))
    close(F_of(model, 0.0, 1.0), np.diag([1.0, 0.0]))
    assert np.isnan(F_of(model, 1.0, 0.0)).all()


def test_tables_and_sensors_are_looked_up_by_index():
    H = np.arange(8.0).reshape(2, 2, 2)
    R = np.stack([np.eye(2), 2.0 * np.eye(2)])
    model = ej.linear_model(np.eye(2), H, R)
    assert model.sensors == 2
    x = jnp.asarray([1.0, -1.0])
    for k in range(2):
        value, seen, cov = predict_measurement(model, None, x, jnp.int32(k), jnp.asarray(0.0))
        close(value, H[k] @ x)
        close(seen, H[k])
        close(cov, R[k])
    group = [bearing_sensor(0.1, (0.0, 0.0)), bearing_sensor(lambda p: p, (1.0, 2.0))]
    world = constant_velocity(sensors=group, dims=2)
    assert world.sensors == 2
    assert world.linear is None
    x = jnp.asarray([3.0, 4.0, 0.0, 0.0])
    close(world.observe(0.2, x, jnp.int32(1), jnp.asarray(0.0)), [np.arctan2(2.0, 2.0)])
    close(world.measurement_cov(0.2, jnp.int32(1), jnp.asarray(0.0)), [[0.2]])


@given(st.floats(-1e3, 1e3))
def test_wrapped_angles_are_the_same_direction_in_the_half_open_interval(angle):
    wrapped = float(wrap_angle(jnp.asarray(angle)))
    assert -np.pi < wrapped <= np.pi
    np.testing.assert_allclose(np.exp(1j * wrapped), np.exp(1j * angle), atol=1e-9)


def test_pi_itself_stays():
    close(wrap_angle(jnp.asarray([np.pi, -np.pi])), [np.pi, np.pi])


def test_only_the_angles_of_a_bank_wrap():
    world = constant_velocity(sensors=[SEEN, SEEN])
    close(world.residual(jnp.asarray([7.0]), jnp.asarray([0.0]), jnp.int32(1)), [7.0])
    world = constant_velocity(sensors=bearing_sensor(0.1), dims=2)
    close(world.residual(jnp.asarray([3.0]), jnp.asarray([-3.0]), jnp.int32(0)), [6 - 2 * np.pi])


def test_a_target_at_the_bearing_sensor_has_a_finite_gradient():
    sensor = bearing_sensor(0.1, (1.0, 2.0))
    slope = jax.jacobian(lambda x: sensor.observe(None, x, jnp.asarray(0.0)))
    here = jnp.asarray([1.0, 2.0, 0.0, 0.0])
    np.testing.assert_array_equal(slope(here), np.zeros((1, 4)))
    np.testing.assert_array_equal(sensor.observe(None, here, jnp.asarray(0.0)), [0.0])
    second = jax.hessian(lambda x: sensor.observe(None, x, jnp.asarray(0.0))[0])(here)
    assert np.isfinite(second).all()
    close(slope(jnp.asarray([3.0, 2.0, 0.0, 0.0])), [[0.0, 0.5, 0.0, 0.0]])


def test_float32_models_stay_float32():
    model = build("ca", dims=2)
    t0, t1 = jnp.float32(0.0), jnp.float32(0.5)
    moved, F, Q = predict_state(model, None, jnp.zeros(6, jnp.float32), t0, t1)
    assert moved.dtype == F.dtype == Q.dtype == np.float32
