"""Yoder et al. (2018), section 2: closed forms, Riccati equation, Algorithm 1, cut-offs."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles import late
from scipy.linalg import expm, logm, solve_discrete_are

from ewif_jax.analysis.gain_history import gain_history
from ewif_jax.analysis.merit import (
    alpha_beta_eigenvalues,
    alpha_beta_gains,
    cutoff_delay,
    delayed_gain,
    maneuvering_index,
    random_walk_cutoff,
    random_walk_gain,
    steady_state_gain,
)

DT = 0.5
F = np.array([[1.0, DT], [0.0, 1.0]])
H = np.array([[1.0, 0.0]])
G = np.array([[DT**2 / 2], [DT]])
INDICES = (1e-3, 0.05, 1.0, 5.0, 8.0, 50.0, 1e4)


def dwna(index, r=1.3):
    """F, H, Q, R of discrete white-noise acceleration with that maneuvering index."""
    return F, H, index**2 * r / DT**4 * G @ G.T, np.array([[r]])


def test_published_cutoff():
    index = maneuvering_index(20.0, 2000.0, 1.0)
    assert round(float(cutoff_delay(1.0, 1.0, 20.0, 2000.0, ratio=0.6)), 4) == 5.1104
    assert round(float(random_walk_cutoff(index, ratio=0.6)), 4) == 5.1104


@pytest.mark.parametrize(
    ("sigma_q", "published"), [(0.5, 22.845), (5.0, 2.2847), (50.0, 0.2303), (500.0, 0.0331)]
)
def test_cutoffs_of_figures_4_and_5(sigma_q, published):
    index = maneuvering_index(sigma_q**2, 2500.0, 0.2)
    found = random_walk_cutoff(index, ratio=0.6, interval=0.2)
    np.testing.assert_allclose(found, published, rtol=2e-3)
    general = cutoff_delay(1.0, 1.0, sigma_q**2 * 0.2, 2500.0, ratio=0.6, interval=0.2)
    np.testing.assert_allclose(general, found, rtol=1e-9)


@pytest.mark.parametrize("index", INDICES)
def test_closed_forms_solve_the_riccati_equation(index):
    walk = steady_state_gain(1.0, 1.0, index**2, 1.0)
    np.testing.assert_allclose(walk, random_walk_gain(index)[None, None], rtol=1e-10)
    alpha, beta = alpha_beta_gains(index)
    gain = steady_state_gain(*dwna(index))
    np.testing.assert_allclose(gain, np.array([[alpha], [beta / DT]]), rtol=1e-10)


@pytest.mark.parametrize("index", [0.05, 1.0, 5.0])
def test_stable_forms_are_the_printed_ones(index):
    root = np.sqrt(index**4 + 4 * index**2)
    np.testing.assert_allclose(random_walk_gain(index), (-(index**2) + root) / 2)
    root = np.sqrt(index**2 + 8 * index)
    alpha, beta = alpha_beta_gains(index)
    np.testing.assert_allclose(alpha, (-(index**2) - 8 * index + (index + 4) * root) / 8)
    np.testing.assert_allclose(beta, (index**2 + 4 * index - index * root) / 4)


def test_no_digits_are_lost_at_either_end():
    for tiny in (1e-12, np.float32(1e-12)):
        np.testing.assert_allclose(random_walk_gain(tiny), tiny, rtol=1e-6)
        np.testing.assert_allclose(alpha_beta_gains(tiny)[0], np.sqrt(8 * tiny) / 2, rtol=1e-5)
        np.testing.assert_allclose(alpha_beta_gains(tiny)[1], tiny, rtol=1e-5)
    np.testing.assert_allclose(1 - random_walk_gain(1e6), 1e-12, rtol=1e-3)
    np.testing.assert_allclose(random_walk_cutoff(1e9), np.log(0.6) / np.log(1e-18), rtol=1e-9)


@pytest.mark.parametrize("index", [0.3, 2.0, 20.0])
def test_eigenvalues(index):
    system = dwna(index)
    loop = (np.eye(2) - np.asarray(steady_state_gain(*system)) @ H) @ F
    found = np.sort_complex(np.asarray(alpha_beta_eigenvalues(index)))
    np.testing.assert_allclose(found, np.sort_complex(np.linalg.eigvals(loop)), atol=1e-9)
    assert (np.abs(found.imag) > 0).all() == (index < 8)


def test_riccati_equation_with_singular_noise_against_scipy():
    rng = np.random.default_rng(0)
    for n in (1, 3, 6):
        A, C = rng.normal(size=(n, n)), rng.normal(size=(2, n))
        root, R = rng.normal(size=(n, 1)), np.diag([0.5, 2.0])
        P = solve_discrete_are(A.T, C.T, root @ root.T, R)
        expected = P @ C.T @ np.linalg.inv(C @ P @ C.T + R)
        np.testing.assert_allclose(steady_state_gain(A, C, root @ root.T, R), expected, rtol=1e-8)


def test_without_a_steady_state_the_gain_is_nan():
    assert np.isnan(steady_state_gain(np.eye(2), H, np.eye(2), 1.0)).all()


@pytest.mark.parametrize("steps", [0, 1, 4])
def test_delayed_gain_is_the_product_of_the_loops(steps):
    system = dwna(0.7)
    expected = late.delayed_gain(*system, steps)
    np.testing.assert_allclose(delayed_gain(*system, steps), expected, atol=1e-10)
    np.testing.assert_allclose(delayed_gain(*system, float(steps)), expected, atol=1e-10)


def test_real_delays_compose():
    walk = delayed_gain(1.0, 1.0, 0.2, 1.0, 2.5)
    k = random_walk_gain(np.sqrt(0.2))
    np.testing.assert_allclose(walk[0, 0], (1 - k) ** 2.5 * k)


def norm_ratios(system, steps):
    """The norm of the delayed gain at real numbers of steps, over that of a fresh one's: by SciPy's
    Riccati solver and logarithm."""
    F, H, Q, R = system
    P = solve_discrete_are(F.T, H.T, Q, R)
    K = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
    rates = logm((np.eye(len(F)) - K @ H) @ F)
    fine = expm(rates * (steps[1] - steps[0]))
    kept, norms = K.astype(complex), []
    for _ in steps:
        norms.append(np.linalg.norm(kept.real))
        kept = fine @ kept
    return np.array(norms) / norms[0]


@pytest.mark.parametrize(
    ("index", "seconds"),
    [(0.1, 0.8445), (1.0, 0.1566), (7.0, 0.5714), (8.0, 0.6422), (50.0, 3.5718)],
)
def test_the_cutoff_is_the_last_crossing_of_an_oscillating_gain(index, seconds):
    """Also where the two eigenvalues coincide, at lambda = 8."""
    found = cutoff_delay(*dwna(index), ratio=0.6, interval=DT)
    np.testing.assert_allclose(found, seconds, atol=6e-5)
    if index != 8.0:
        steps = np.linspace(0, 20, 20_001)
        last = steps[np.flatnonzero(norm_ratios(dwna(index), steps) >= 0.6)[-1]]
        assert 0 <= found / DT - last < 1.001e-3


def test_the_last_crossing_is_found_among_many():
    """Slow rotations, damped by little: hundreds of crossings, and the last one counts."""
    rng = np.random.default_rng(3)
    for _ in range(3):
        turn, squeeze = rng.uniform(0.3, 1.0), np.diag([1.0, rng.uniform(1.5, 3.0)])
        c, s = np.cos(turn), np.sin(turn)
        F = squeeze @ np.array([[c, -s], [s, c]]) @ np.linalg.inv(squeeze)
        system = F, np.array([[1.0, 0.4]]), 1e-4 * np.eye(2), np.eye(1)
        steps = np.linspace(0, 400, 80_001)
        above = norm_ratios(system, steps) >= 0.4
        assert np.abs(np.diff(above.astype(int))).sum() > 5
        found = cutoff_delay(*system, ratio=0.4)
        assert 0 <= found - steps[np.flatnonzero(above)[-1]] < 5.001e-3


GROWING = {
    "one state": (np.array([[1.1]]), np.array([[1.0]]), np.zeros((1, 1)), np.eye(1)),
    "beside a driven one": (
        np.diag([1.1, 0.9]), np.array([[1.0, 1.0]]), np.diag([0.0, 1.0]), np.eye(1),
    ),
    "three states": (
        np.array([[1.2, 0.3, 0.0], [0.0, 0.8, 0.1], [0.0, 0.0, 1.05]]),
        np.array([[1.0, 0.0, 0.5], [0.0, 1.0, 0.0]]), np.zeros((3, 3)), np.diag([0.5, 2.0]),
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", GROWING)
def test_a_growing_mode_without_noise_is_followed(name):
    """The equation has several solutions; the filter converges to the one that is stable."""
    F, H, Q, R = GROWING[name]
    P = solve_discrete_are(F.T, H.T, Q, R)
    expected = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
    found = steady_state_gain(F, H, Q, R)
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(found, late.steady_gain(F, H, Q, R), rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(
        delayed_gain(F, H, Q, R, 3), late.delayed_gain(F, H, Q, R, 3), rtol=1e-8, atol=1e-12
    )
    steps = np.linspace(0, 60, 60_001)
    last = steps[np.flatnonzero(norm_ratios((F, H, Q, R), steps) >= 0.6)[-1]]
    assert 0 <= cutoff_delay(F, H, Q, R) - last < 1.001e-3
    slope, h = jax.jit(jax.grad(lambda r: cutoff_delay(F, H, Q, r * R)))(1.3), 1e-4
    ends = [cutoff_delay(F, H, Q, (1.3 + s) * R) for s in (h, -h)]
    np.testing.assert_allclose(slope, (ends[0] - ends[1]) / (2 * h), rtol=1e-5, atol=1e-8)


def test_where_no_cutoff_exists_it_says_so():
    still = 1.0, 1.0, 0.0, 1.0
    np.testing.assert_array_equal(steady_state_gain(*still), [[0.0]])
    assert np.isnan(cutoff_delay(*still))
    assert np.isnan(cutoff_delay(np.eye(2), H, np.eye(2), 1.0))
    resting = np.diag([1.1, 1.0]), np.ones((1, 2)), np.zeros((2, 2)), 1.0
    np.testing.assert_allclose(steady_state_gain(*resting), [[0.21 / 1.21], [0.0]], atol=1e-12)
    assert np.isposinf(cutoff_delay(*resting))
    assert cutoff_delay(0.0, 1.0, 1.0, 1.0) == 0


def test_equal_axes_have_derivatives():
    """Two axes of one motion: every eigenvalue of the loop is there twice."""
    F2, H2, Q2 = (np.kron(np.eye(2), x) for x in (F, H, G @ G.T))

    def loss(q):
        system = F2, H2, q * Q2, np.eye(2)
        return cutoff_delay(*system) + jnp.sum(delayed_gain(*system, 1.5))

    expected = (loss(3 + 1e-5) - loss(3 - 1e-5)) / 2e-5
    np.testing.assert_allclose(jax.jit(jax.grad(loss))(3.0), expected, rtol=1e-7)
    alone = cutoff_delay(F, H, 3 * G @ G.T, 1.0)
    np.testing.assert_allclose(cutoff_delay(F2, H2, 3 * Q2, np.eye(2)), alone, rtol=1e-9)


def test_algorithm_1_at_equal_intervals_is_the_closed_form():
    system = dwna(0.4)
    equal = (np.broadcast_to(system[0], (199, 2, 2)), np.broadcast_to(system[2], (199, 2, 2)))
    history = gain_history(equal[0], H, equal[1], system[3], np.eye(2), lag=6)
    for k in range(7):
        np.testing.assert_allclose(history.gain[-1, k], delayed_gain(*system, k), atol=1e-10)


def test_algorithm_1_at_irregular_times():
    intervals = np.array([0.3, 0.1, 0.7, 0.2])
    q = 0.64 * intervals[:, None, None]
    history = gain_history(
        np.ones((4, 1, 1)), np.array([[1.7]]), q, np.array([[1.21]]), np.array([[2.5]]), lag=4
    )
    expected = late.ideal_gains(intervals, 0.8, 1.1, first_cov=2.5, h=1.7)
    lower = np.tri(5, dtype=bool)
    np.testing.assert_allclose(history.gain[..., 0, 0][lower], expected[:, :5][lower], rtol=1e-12)
    np.testing.assert_array_equal(history.gain[..., 0, 0][~lower], 0)
    np.testing.assert_allclose(
        history.initial[:, 0, 0], expected[np.arange(5), np.arange(1, 6)], rtol=1e-12
    )


def test_gradients():
    """In q, r and the delay, through the Riccati equation, against finite differences."""
    Q = G @ G.T

    def loss(x):
        system = F, H, x[0] * Q, x[1:2, None]
        delayed = delayed_gain(*system, x[2])
        return jnp.sum(steady_state_gain(*system)) + jnp.sum(delayed) + cutoff_delay(*system)

    at, h = jnp.array([1.2, 0.4, 2.5]), 1e-6
    shifts = h * np.eye(3)
    expected = [(loss(at + s) - loss(at - s)) / (2 * h) for s in shifts]

    @jax.jit
    def both_modes(at):
        _, push = jax.linearize(loss, at)
        return jax.vmap(push)(jnp.eye(3)), *jax.linear_transpose(push, at)(jnp.ones(()))

    for found in both_modes(at):
        np.testing.assert_allclose(found, expected, rtol=1e-6)


def test_what_is_refused():
    with pytest.raises(ValueError, match="R: expected a positive semidefinite matrix"):
        steady_state_gain(1.0, 1.0, 1.0, -1.0)
    with pytest.raises(ValueError, match=r"Q: expected shape \(2, 2\)"):
        steady_state_gain(F, H, 1.0, 1.0)
    with pytest.raises(ValueError, match="ratio"):
        cutoff_delay(1.0, 1.0, 1.0, 1.0, ratio=1.0)
    with pytest.raises(ValueError, match="motion"):
        maneuvering_index(1.0, 1.0, 1.0, "walk")
    with pytest.raises(ValueError, match="steps"):
        delayed_gain(1.0, 1.0, 1.0, 1.0, -1)
