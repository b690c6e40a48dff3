"""The coordinated turn is the motion it says, in both directions and next to turn rate zero."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from laws.cases import close
from scipy.integrate import solve_ivp

import ewif_jax as ej
from ewif_jax.models import bearing_sensor, constant_velocity, coordinated_turn, predict_state

SEEN = bearing_sensor(0.1)
TURN = coordinated_turn(sensors=SEEN, q=2.0, q_turn=lambda p: p)
RATES = st.one_of(st.floats(-2.0, 2.0), st.sampled_from([0.0, 1e-160, 1e-9, -1e-4, 0.1]))


def start(rate, dtype=np.float64):
    return jnp.asarray([-500.0, 500.0, 20.0, 50.0, rate], dtype)


@jax.jit
def move(x, t0, t1):
    return TURN.transition(None, x, t0, t1)


@jax.jit
def jacobian(x, t0, t1):
    return jax.jacfwd(lambda x: TURN.transition(None, x, t0, t1))(x)


@jax.jit
def flowing(q_turn, x, t0, t1):
    return predict_state(TURN, q_turn, x, t0, t1)


def integrated(x, t0, t1):
    """The differential equation of the turn, by a general solver."""
    spin = np.array([[0.0, -x[4]], [x[4], 0.0]])

    def rate(t, y):
        return np.concatenate([y[2:4], spin @ y[2:4], [0.0]])

    return solve_ivp(rate, (t0, t1), np.asarray(x), rtol=1e-11, atol=1e-11).y[:, -1]


@pytest.mark.parametrize("rate", [0.0, 1e-7, -0.11, 0.9, -4.0])
@pytest.mark.parametrize("until", [0.3, 4.0, -2.5])
def test_it_solves_the_equation_of_the_turn(rate, until):
    x = start(rate)
    close(move(x, 1.0, 1.0 + until), integrated(x, 1.0, 1.0 + until), 1e-9)


@given(rate=RATES, t0=st.floats(-5, 5), t1=st.floats(-5, 5), t2=st.floats(-5, 5))
def test_motion_composes_and_reverses(rate, t0, t1, t2):
    x = start(rate)
    np.testing.assert_allclose(move(move(x, t0, t1), t1, t2), move(x, t0, t2), atol=1e-9)
    np.testing.assert_allclose(move(move(x, t0, t1), t1, t0), x, atol=1e-9)


def test_the_circle_of_the_paper():
    """200 km/h on a radius of 500 m, clockwise from heading north: a quarter turn goes to the
    top of the circle."""
    speed = 200 / 3.6
    x = jnp.asarray([-500.0, 500.0, 0.0, speed, -speed / 500])
    close(move(x, 0.0, np.pi / 2 * 500 / speed), [0.0, 1000.0, speed, 0.0, -speed / 500], 1e-9)


@pytest.mark.parametrize("rate", [0.0, 1e-160, 1e-12, 1e-5, -0.03, 0.24, 0.26])
def test_jacobian_is_the_difference_quotient_also_at_rate_zero(rate):
    x, step = start(rate), 1e-6
    found = np.asarray(jacobian(x, 0.0, 4.0))
    for i, unit in enumerate(np.eye(5)):
        quotient = (move(x + step * unit, 0.0, 4.0) - move(x - step * unit, 0.0, 4.0)) / (2 * step)
        np.testing.assert_allclose(found[:, i], quotient, rtol=2e-7, atol=2e-5)


def test_derivatives_at_rate_zero_are_the_analytic_limits():
    """d position / d rate = dt^2/2 times the velocity turned by 90 degrees; and finite above."""
    x = start(0.0)
    close(jacobian(x, 0.0, 3.0)[:2, 4], 4.5 * np.array([-50.0, 20.0]), 1e-12)
    second = jax.jit(jax.hessian(lambda x: TURN.transition(None, x, 0.0, 3.0)[0]))(x)
    close(second[4, 4], -9.0 * 20.0, 1e-10)
    at_once = jax.jit(jax.jacrev(lambda t: TURN.transition(None, x, 1.0, t)))(1.0)
    close(at_once, [20.0, 50.0, 0.0, 0.0, 0.0])


def test_turning_at_rate_zero_is_constant_velocity():
    x, t0, t1 = start(0.0), jnp.asarray(0.4), jnp.asarray(2.1)
    straight = constant_velocity(sensors=SEEN, q=2.0, dims=2)
    moved, F, Q = flowing(0.3, x, t0, t1)
    there, F_there, Q_there = jax.jit(partial(predict_state, straight, None))(x[:4], t0, t1)
    close(moved[:4], there)
    close(F[:4, :4], F_there)
    close(Q[:4, :4], Q_there)
    close(Q[4], [0.0, 0.0, 0.0, 0.0, 0.3 * 1.7])
    close(TURN.process_cov(0.3, t1, t0), Q)


def test_noise_of_an_interval_is_that_of_its_parts():
    def Q(t0, t1):
        return np.asarray(TURN.process_cov(0.3, jnp.asarray(t0), jnp.asarray(t1)))

    F = np.eye(5) + 0.9 * np.eye(5, k=2) * np.array([0, 0, 1, 1, 0])
    close(Q(0.0, 1.6), F @ Q(0.0, 0.7) @ F.T + Q(0.7, 1.6), 1e-12)
    assert np.all(np.linalg.eigvalsh(Q(0.0, 0.7)) > 0)
    close(Q(0.7, 0.7), np.zeros((5, 5)))


@pytest.mark.parametrize("rate", [0.0, 1e-6, 1e-3, -0.11, 0.6])
def test_float32_keeps_its_digits(rate):
    x, t0, t1 = start(rate, np.float32), jnp.float32(0.0), jnp.float32(3.0)
    moved, F, Q = flowing(np.float32(0.3), x, t0, t1)
    exact, F_exact, Q_exact = flowing(0.3, x.astype(float), float(t0), float(t1))
    assert moved.dtype == F.dtype == Q.dtype == np.float32
    np.testing.assert_allclose(moved, exact, rtol=1e-6)
    np.testing.assert_allclose(F, F_exact, rtol=1e-5, atol=1e-6 * np.abs(F_exact).max())
    np.testing.assert_allclose(Q, Q_exact, rtol=1e-6)


def test_what_cannot_be_is_refused():
    with pytest.raises(ValueError, match="q_turn: expected a number >= 0"):
        coordinated_turn(sensors=SEEN, q_turn=-0.1)
    with pytest.raises(ValueError, match="q: expected shape"):
        coordinated_turn(sensors=SEEN, q=[1.0, 2.0])
    prior = ej.Gaussian(np.zeros(4), np.eye(4))
    with pytest.raises(ValueError, match=r"state: expected shape \(5,\), got shape \(4,\)"):
        ej.run(ej.extended(TURN), 0.1, ej.stream([1.0], [0.3]), prior=prior, t0=0.0)
