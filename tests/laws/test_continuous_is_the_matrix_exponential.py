"""`from_continuous` is the matrix exponential, the kinematic models, and what quadrature gives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import quad_vec
from scipy.linalg import expm, expm_frechet

import ewif_jax as ej
from ewif_jax.models import affine_flow, from_continuous, position_sensor
from laws.cases import close

RNG = np.random.default_rng(0)
UNSTABLE = RNG.normal(size=(3, 3))
WORLDS = {
    "random": UNSTABLE,
    "stable and stiff": np.diag([-0.3, -2.0, -40.0]) + np.triu(UNSTABLE, 1),
    "integrators": np.eye(3, k=1),
    "oscillator": np.array([[0.0, 5.0, 0.0], [-5.0, 0.0, 0.1], [0.0, 0.0, -0.5]]),
}
G, SPECTRUM = RNG.normal(size=(3, 2)), np.array([[0.5, 0.1], [0.1, 0.2]])
PUSH = np.array([0.3, -0.2, 0.1])
ROW, NOISE = np.eye(1, 3), np.eye(1)


@jax.jit
def matrices(params, t0, t1):
    model = from_continuous(
        lambda p: p["A"], lambda p: p["G"], lambda p: p["q"], H=ROW, R=NOISE, b=lambda p: p["b"]
    )
    F, c = affine_flow(model, params, t0, t1, t0.dtype)
    return F, model.process_cov(params, t0, t1), c


def params(A):
    return {"A": A, "G": G, "q": SPECTRUM, "b": PUSH}


@pytest.mark.parametrize("name", WORLDS)
@pytest.mark.parametrize("dt", [0.0, 1e-3, 0.4, 3.0, -0.4])
def test_against_the_exponential_and_quadrature(name, dt):
    A = WORLDS[name]
    F, Q, c = matrices(params(A), jnp.asarray(1.0), jnp.asarray(1.0 + dt))
    dt = (1.0 + dt) - 1.0
    close(F, expm(A * dt), 1e-11)
    close(c, quad_vec(lambda s: expm(A * s) @ PUSH, 0, dt, epsrel=1e-12)[0], 1e-9)
    if dt >= 0:
        N = G @ SPECTRUM @ G.T
        spread = quad_vec(lambda s: expm(A * s) @ N @ expm(A * s).T, 0, dt, epsrel=1e-12)[0]
        close(Q, spread, 1e-9)


@pytest.mark.parametrize("order", [0, 1, 2])
def test_integrators_are_the_kinematic_models(order):
    n, sensor = order + 1, position_sensor(0.5, 2)
    build = [ej.models.random_walk, ej.models.constant_velocity, ej.models.constant_acceleration]
    known = build[order](sensors=sensor, q=0.7, dims=2)
    A, drive = np.kron(np.eye(n, k=1), np.eye(2)), np.kron(np.eye(n)[:, -1:], np.eye(2))
    made = from_continuous(A, drive, 0.7, sensor)
    assert (made.sensors, made.linear.F_where) == (1, known.linear.F_where)
    for t1 in (1.0, 1.02, 3.5):
        times = jnp.asarray(1.0), jnp.asarray(t1)
        close(made.process_cov(None, *times), known.process_cov(None, *times), 1e-13)
        close(made.linear.F(None, *times), known.linear.F(None, *times), 1e-13)


def test_a_long_gap_of_a_stable_model_ends_in_its_stationary_covariance():
    """Where the backward exponential of Van Loan's block matrix overflows."""
    A, N = WORLDS["stable and stiff"], G @ SPECTRUM @ G.T
    for dtype, digits in ((np.float64, 1e-10), (np.float32, 1e-5)):
        cast = jax.tree.map(lambda x, dtype=dtype: np.asarray(x, dtype), params(A))
        F, Q, _ = matrices(cast, jnp.zeros((), dtype), jnp.asarray(1e4, dtype))
        assert Q.dtype == dtype
        residual = A @ np.asarray(Q, float) + np.asarray(Q, float) @ A.T + N
        assert np.abs(residual).max() < digits * 40 * np.abs(Q).max()
        close(F, np.zeros((3, 3)), 1e-9)


def test_derivatives_in_the_matrix_and_in_the_times():
    A, direction, dt = WORLDS["random"], RNG.normal(size=(3, 3)), 0.7

    def found(A, t1):
        return matrices({**params(A), "b": PUSH}, jnp.asarray(0.0), t1)

    tangent = jax.jvp(lambda A: found(A, jnp.asarray(dt)), (A,), (direction,))[1]
    close(tangent[0], expm_frechet(A * dt, direction * dt, compute_expm=False), 1e-9)
    slope = jax.jvp(lambda t: found(A, t), (jnp.asarray(dt),), (jnp.asarray(1.0),))[1]
    F, N = expm(A * dt), G @ SPECTRUM @ G.T
    close(slope[0], A @ F, 1e-9)
    close(slope[1], F @ N @ F.T, 1e-9)
    close(slope[2], F @ PUSH, 1e-9)
    back = jax.grad(lambda t: jnp.sum(found(A, t)[1]))(jnp.asarray(0.0))
    close(back, N.sum(), 1e-9)


def test_what_does_not_fit_is_named():
    for given, word in (
        ((np.eye(2), np.ones((3, 1)), 1.0), "G"),
        ((np.eye(2), np.ones((2, 1)), -1.0), "intensity"),
        ((np.ones((2, 3)), np.ones((2, 1)), 1.0), "A"),
    ):
        with pytest.raises(ValueError, match=word):
            from_continuous(*given, H=np.eye(1, 2), R=NOISE)
    with pytest.raises(ValueError, match="sensors"):
        from_continuous(np.eye(2), np.ones((2, 1)), 1.0)
    model = from_continuous(np.eye(1), np.eye(1), lambda p: p, position_sensor(1.0))
    stream, prior = ej.stream([1.0], [0.0]), ej.Gaussian(np.zeros(1), np.eye(1))
    with pytest.raises(ValueError, match="intensity"):
        ej.run(ej.kalman(model), -1.0, stream, prior=prior, t0=0.0)
