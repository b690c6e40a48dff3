"""Anderson (1973): what exponential data weighting does, section by section."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles import kalman_loop
from scipy.integrate import solve_ivp
from scipy.linalg import solve_continuous_are, solve_discrete_are

import ewif_jax as ej
from ewif_jax.analysis.anderson import (
    System,
    actual_error,
    error_bounds,
    steady_state,
    weighted_covariances,
    weighting_as_process_noise,
)
from ewif_jax.analysis.anderson_continuous import (
    ContinuousSystem,
    steady_state_continuous,
    weighting_as_input_noise,
)
from ewif_jax.analysis.stability import spectral_abscissa, spectral_radius
from ewif_jax.continuous.error import actual_error_continuous, error_bounds_continuous
from ewif_jax.scenarios.divergence import (
    PUSHES,
    divergence,
    divergence_curve,
    divergence_filter,
)

STEPS = 12
SEEDS = st.integers(0, 2**32 - 1)
SETTINGS = {"none": None, "noise": 0.4, "weighting": 0.35, "memory": 3.0}


def random_system(seed, n=3, m=2, noise_rank=2):
    rng = np.random.default_rng(seed)
    F = rng.normal(size=(n, n))
    F *= rng.uniform(0.6, 1.3) / np.abs(np.linalg.eigvals(F)).max()
    root, spread = rng.normal(size=(n, noise_rank)), rng.normal(size=(n, n))
    system = System(F, rng.normal(size=(m, n)), root @ root.T, np.diag(rng.uniform(0.2, 2, m)))
    return system, spread @ spread.T + 0.1 * np.eye(n)


def smallest(x):
    return np.linalg.eigvalsh(np.asarray(x)).min()


def assert_ordered(best, error, design):
    scale = np.abs(design).max()
    assert smallest(error - best) > -1e-10 * scale
    assert smallest(design - error) > -1e-10 * scale


@settings(max_examples=20, deadline=None, derandomize=True)
@given(SEEDS, st.floats(1.0, 1.4))
def test_error_lies_between_the_best_and_the_believed(seed, fading):
    """(5-18), in the order of positive semidefinite matrices."""
    system, cov0 = random_system(seed)
    assert_ordered(*error_bounds(system, cov0, fading=jnp.asarray(fading), steps=STEPS))


@settings(max_examples=10, deadline=None, derandomize=True)
@given(SEEDS, st.floats(1.01, 1.4))
def test_scaled_covariance_is_that_of_scaled_noise(seed, fading):
    """(5-12): Pi(k) = alpha^(2 (k - k0)) P_alpha(k), with R and Q of (5-7)."""
    system, cov0 = random_system(seed)
    scale = fading ** (2.0 * np.arange(1, STEPS + 1))[:, None, None]
    shrunk = System(system.F, system.H, system.Q / scale, system.R / scale)
    plain = weighted_covariances(shrunk, cov0, fading=jnp.ones(()), steps=STEPS)
    weighted = weighted_covariances(system, cov0, fading=jnp.asarray(fading), steps=STEPS)
    np.testing.assert_allclose(weighted.cov, scale * plain.cov, rtol=1e-8, atol=1e-10)
    np.testing.assert_allclose(weighted.gain, plain.gain, rtol=1e-8, atol=1e-10)


@settings(max_examples=10, deadline=None, derandomize=True)
@given(SEEDS, st.floats(1.0, 1.4))
def test_weighting_is_more_process_noise(seed, fading):
    """(5-16) with Pi(k-1): the filter without weighting then has the same gains."""
    system, cov0 = random_system(seed)
    weighted = weighted_covariances(system, cov0, fading=jnp.asarray(fading), steps=STEPS)
    before = jnp.concatenate([cov0[None], weighted.cov[:-1]])
    F, Q = jnp.asarray(system.F), jnp.asarray(system.Q)
    noise = jax.vmap(lambda cov: weighting_as_process_noise(F, Q, cov, fading))(before)
    noisier = System(system.F, system.H, noise, system.R)
    plain = weighted_covariances(noisier, cov0, fading=jnp.ones(()), steps=STEPS)
    np.testing.assert_allclose(plain.gain, weighted.gain, rtol=1e-9, atol=1e-11)
    assert smallest(np.asarray(noise) - system.Q) > -1e-12


def as_oracle(system, cov0):
    return {
        "t0": 0.0, "prior_cov": cov0, "F": lambda t0, t1: system.F, "Q": lambda t0, t1: system.Q,
        "times": np.arange(1.0, STEPS + 1), "H": [system.H] * STEPS, "R": [system.R] * STEPS,
    }  # fmt: skip


def test_covariances_and_error_are_the_loops():
    system, cov0 = random_system(3)
    weighted = weighted_covariances(system, cov0, fading=jnp.asarray(1.2), steps=STEPS)
    loop = kalman_loop.fading_filter(
        **as_oracle(system, cov0), prior_mean=np.zeros(3), values=np.zeros((STEPS, 2)),
        alphas=np.full(STEPS, 1.2),
    )  # fmt: skip
    np.testing.assert_allclose(weighted.cov, loop.covs, rtol=1e-10)
    np.testing.assert_allclose(weighted.gain, np.stack(loop.gains), rtol=1e-9, atol=1e-12)
    error = kalman_loop.actual_error(**as_oracle(system, cov0), gains=loop.gains)
    np.testing.assert_allclose(actual_error(weighted.gain, system, cov0), error, rtol=1e-10)
    same = actual_error(weighted.gain, system, cov0, design=system, mean0=np.ones(3))
    np.testing.assert_allclose(same, error, rtol=1e-9)


@pytest.mark.parametrize("mismatch", [False, True])
def test_monte_carlo_error_is_the_actual_error(mismatch):
    """Mean square errors of simulated runs within their 4.5-sigma bands, F and H wrong or not."""
    runs = 4000
    design, cov0 = random_system(5)
    other = random_system(6)[0]
    truth = System(0.8 * other.F, other.H, design.Q, design.R) if mismatch else design
    mean0 = np.array([1.0, -2.0, 0.5])
    gain = np.asarray(weighted_covariances(design, cov0, fading=1.15, steps=STEPS).gain)
    exact = actual_error(gain, truth, cov0, design=design if mismatch else None, mean0=mean0)
    rng = np.random.default_rng(7)
    x = rng.multivariate_normal(mean0, cov0, runs)
    estimate = np.tile(mean0, (runs, 1))
    for k in range(STEPS):
        x = x @ truth.F.T + rng.multivariate_normal(np.zeros(3), truth.Q, runs)
        z = x @ truth.H.T + rng.multivariate_normal(np.zeros(2), truth.R, runs)
        estimate = estimate @ design.F.T
        estimate = estimate + (z - estimate @ design.H.T) @ gain[k].T
        squares = np.einsum("ri,rj->rij", x - estimate, x - estimate)
        band = 4.5 * squares.std(axis=0) / np.sqrt(runs)
        assert np.all(np.abs(squares.mean(axis=0) - exact[k]) < band)


@pytest.mark.parametrize("fading", [1.0, 1.15])
def test_steady_state(fading):
    """Against SciPy with alpha F; degree of stability; limit of the transient; (5-18) again."""
    for seed in range(6):
        system, cov0 = random_system(seed, n=3, noise_rank=3)
        steady = steady_state(system, fading=jnp.asarray(fading))
        expected = solve_discrete_are(fading * system.F.T, system.H.T, system.Q, system.R)
        scale = np.abs(expected).max()
        np.testing.assert_allclose(steady.predicted / scale, expected / scale, atol=1e-9)
        assert spectral_radius(steady.closed_loop) <= 1 / fading + 1e-12
        transient = error_bounds(system, cov0, fading=jnp.asarray(fading), steps=400)
        np.testing.assert_allclose(transient.design[-1] / scale, steady.cov / scale, atol=1e-9)
        np.testing.assert_allclose(transient.error[-1] / scale, steady.error / scale, atol=1e-9)


def test_steady_state_without_noise_is_the_ewif():
    """Q = 0: only the weighting keeps the gain from zero; rho = exp(-dt / tau), ERRATA 5."""
    tau, dt = 0.7, 0.1
    still = System(np.eye(1), np.eye(1), np.zeros((1, 1)), np.array([[0.5]]))
    steady = steady_state(still, fading=jnp.exp(dt / (2 * tau)))
    rho = np.exp(-dt / tau)
    np.testing.assert_allclose(steady.gain, [[1 - rho]], rtol=1e-12)
    np.testing.assert_allclose(steady.cov, [[0.5 * (1 - rho)]], rtol=1e-12)
    np.testing.assert_allclose(steady.error, [[0.5 * (1 - rho) / (1 + rho)]], rtol=1e-12)
    model = ej.models.random_walk(sensors=ej.models.position_sensor(0.5))
    data = ej.stream(dt * np.arange(200), np.ones(200))
    trace = ej.run(ej.ewif(model, tau), None, data, prior=None, t0=0.0)
    np.testing.assert_allclose(trace.cov[-1], steady.cov, rtol=1e-9)


def test_steady_state_derivatives():
    system, _ = random_system(2)

    def loss(fading, scale):
        steady = steady_state(
            system._replace(Q=scale * system.Q, R=system.R / scale), fading=fading
        )
        return jnp.trace(steady.error) + jnp.sum(steady.gain)

    def loss_continuous(rate, scale):
        driven = continuous(2)._replace(Q=scale * np.eye(2), R=np.eye(2) / scale)
        steady = steady_state_continuous(driven, fading_rate=rate)
        return jnp.trace(steady.error) + jnp.sum(steady.gain)

    for of, at in ((loss, (1.1, 0.9)), (loss_continuous, (0.2, 0.9))):
        fn = jax.jit(of)
        slopes = jax.jit(jax.grad(of, argnums=(0, 1)))(*at)
        for k in range(2):
            up, down = (tuple(x + s * (i == k) for i, x in enumerate(at)) for s in (1e-5, -1e-5))
            np.testing.assert_allclose(slopes[k], (fn(*up) - fn(*down)) / 2e-5, rtol=1e-6)


def test_what_has_no_steady_state_is_refused():
    blind = System(np.eye(2), np.array([[1.0, 0.0]]), np.eye(2), np.eye(1))
    with pytest.raises(ValueError, match=r"H: .*observability"):
        steady_state(blind)
    still = System(np.eye(1), np.eye(1), np.zeros((1, 1)), np.eye(1))
    with pytest.raises(ValueError, match="Q: "):
        steady_state(still)
    with pytest.raises(ValueError, match="fading"):
        steady_state(still, fading=0.9)
    with pytest.raises(ValueError, match="Q: "):
        steady_state_continuous(ContinuousSystem(still.Q, still.F, still.H, still.Q, still.R))


def continuous(seed):
    rng = np.random.default_rng(seed)
    return ContinuousSystem(
        rng.normal(size=(3, 3)), rng.normal(size=(3, 2)), rng.normal(size=(2, 3)),
        np.eye(2), np.diag(rng.uniform(0.2, 2.0, 2)),
    )  # fmt: skip


@pytest.mark.parametrize("rate", [0.0, 0.3])
def test_steady_state_continuous(rate):
    """Against SciPy with F + alpha I; real parts <= -alpha; (4-7); (4-11)."""
    for seed in range(6):
        system = continuous(seed)
        steady = steady_state_continuous(system, fading_rate=jnp.asarray(rate))
        noise = system.G @ system.Q @ system.G.T
        F = system.F + rate * np.eye(3)
        expected = solve_continuous_are(F.T, system.H.T, noise, system.R)
        scale = np.abs(expected).max()
        np.testing.assert_allclose(steady.cov / scale, expected / scale, atol=1e-9)
        assert spectral_abscissa(steady.closed_loop) <= -rate + 1e-9
        louder = weighting_as_input_noise(noise, steady.cov, rate)
        same = solve_continuous_are(system.F.T, system.H.T, louder, system.R)
        np.testing.assert_allclose(steady.cov / scale, same / scale, atol=1e-8)
        best = steady_state_continuous(system).cov
        assert_ordered(best, steady.error, steady.cov)


def test_actual_error_settles_between_the_bounds():
    system = continuous(1)
    cov0 = np.eye(3)
    times = np.array([0.0, 0.5, 2.0, 40.0])
    best = actual_error_continuous(system, None, cov0, times=times)
    curve = actual_error_continuous(system, None, cov0, times=times, fading_rate=0.3)
    np.testing.assert_allclose(best.error, best.design, rtol=1e-7, atol=1e-9)
    scale = np.abs(curve.design).max()
    assert smallest(curve.error - best.error) > -1e-8 * scale
    assert smallest(curve.design - curve.error) > -1e-8 * scale
    steady = steady_state_continuous(system, fading_rate=0.3)
    np.testing.assert_allclose(curve.error[-1], steady.error, rtol=1e-7, atol=1e-8 * scale)


def varying(system, seed):
    """The system with every matrix varying, as functions of t for NumPy, and for us of (p, t)."""
    rng = np.random.default_rng(seed)
    swings = [0.3 * rng.uniform(size=np.shape(x)) for x in system]
    swings[3], swings[4] = 0.2 * np.eye(len(swings[3])), 0.2 * np.eye(len(swings[4]))
    numbers = [
        lambda t, x=x, s=s, k=k: x + s * np.sin((1 + k) * t)
        for k, (x, s) in enumerate(zip(system, swings, strict=True))
    ]
    ours = [
        lambda p, t, x=x, s=s, k=k: x + jnp.asarray(s) * jnp.sin((1 + k) * t)
        for k, (x, s) in enumerate(zip(system, swings, strict=True))
    ]
    return numbers, ContinuousSystem(*ours)


def dense_error(design, truth, rate, cov0, mean0, times):
    """E and Pi by SciPy: the second moments of state and *estimate*, integrated as they stand."""
    n = len(mean0)

    def slope(t, y):
        S, P = y[: 4 * n * n].reshape(2 * n, 2 * n), y[4 * n * n :].reshape(n, n)
        Fd, Gd, Hd, Qd, Rd = (x(t) for x in design)
        F, G, H, Q, R = (x(t) for x in truth)
        K = P @ Hd.T @ np.linalg.inv(Rd)
        move = np.block([[F, np.zeros((n, n))], [K @ H, Fd - K @ Hd]])
        noise = np.block([[G @ Q @ G.T, np.zeros((n, n))], [np.zeros((n, n)), K @ R @ K.T]])
        P_slope = Fd @ P + P @ Fd.T + 2 * rate(t) * P - K @ Rd @ K.T + Gd @ Qd @ Gd.T
        return np.concatenate([(move @ S + S @ move.T + noise).ravel(), P_slope.ravel()])

    away = np.outer(mean0, mean0)
    start = np.block([[cov0 + away, away], [away, away]])
    y = solve_ivp(
        slope, (times[0], times[-1]), np.concatenate([start.ravel(), cov0.ravel()]), "DOP853",
        times, rtol=1e-11, atol=1e-12,
    ).y.T  # fmt: skip
    S = y[:, : 4 * n * n].reshape(-1, 2 * n, 2 * n)
    error = S[:, :n, :n] - S[:, :n, n:] - S[:, n:, :n] + S[:, n:, n:]
    return error, y[:, 4 * n * n :].reshape(-1, n, n)


def calm(seed):
    """`continuous`, with a motion that does not run away."""
    system = continuous(seed)
    return system._replace(F=system.F - 1.5 * np.eye(3))


CURVE_TIMES = np.array([0.0, 0.3, 1.0, 2.5])
COV0, MEAN0 = np.diag([1.0, 0.5, 2.0]), np.array([1.0, -2.0, 0.5])


def test_actual_error_in_another_system_is_the_dense_integration():
    """F, G, H, Q, R and alpha differ from the design's, and all vary with time."""
    design, our_design = varying(calm(3), 1)
    truth, our_truth = varying(calm(4), 2)
    error, cov = dense_error(design, truth, lambda t: 0.2 + 0.1 * t, COV0, MEAN0, CURVE_TIMES)
    curve = actual_error_continuous(
        our_design, None, COV0, times=CURVE_TIMES, fading_rate=lambda p, t: 0.2 + 0.1 * t,
        truth=our_truth, mean0=MEAN0,
    )  # fmt: skip
    np.testing.assert_allclose(curve.error, error, rtol=1e-7, atol=1e-8)
    np.testing.assert_allclose(curve.design, cov, rtol=1e-7, atol=1e-8)
    assert np.abs(curve.error[-1] - curve.design[-1]).max() > 0.1


def test_actual_error_in_another_system_is_that_of_fine_sampling():
    """The sampled weighted filter of the same two systems, twice as close with half the step."""
    design, truth = calm(3), calm(4)
    rate, length = 0.25, 1.0
    exact = actual_error_continuous(
        design, None, COV0, times=np.array([0.0, length]), fading_rate=rate, truth=truth,
        mean0=MEAN0,
    ).error[-1]  # fmt: skip

    def sampled(steps):
        dt = length / steps

        def at(system):
            F, G, H, Q, R = system
            return System(np.eye(3) + dt * F, H, dt * G @ Q @ G.T, R / dt)

        fading = np.exp(rate * dt)
        gain = weighted_covariances(at(design), COV0, fading=fading, steps=steps).gain
        return actual_error(gain, at(truth), COV0, design=at(design), mean0=MEAN0)[-1]

    coarse, fine = sampled(1000), sampled(2000)
    scale = np.abs(exact).max()
    np.testing.assert_allclose(2 * fine - coarse, exact, atol=2e-4 * scale)
    assert np.abs(fine - exact).max() < 0.6 * np.abs(coarse - exact).max() < 0.02 * scale


def test_a_truth_with_other_noises_only_solves_4_9():
    """Then the state cancels, whatever its mean, and a truth equal to the design is no truth."""
    design = calm(3)
    plain = actual_error_continuous(design, None, COV0, times=CURVE_TIMES, fading_rate=0.3)
    same = actual_error_continuous(
        design, None, COV0, times=CURVE_TIMES, fading_rate=0.3, truth=design, mean0=MEAN0
    )
    np.testing.assert_allclose(same.error, plain.error, rtol=1e-8, atol=1e-9)
    loud = design._replace(Q=4 * design.Q, R=3 * design.R)
    K = steady_state_continuous(design, fading_rate=0.3).gain
    settled = actual_error_continuous(
        design, None, COV0, times=np.array([0.0, 40.0]), fading_rate=0.3, truth=loud, mean0=MEAN0
    ).error[-1]
    closed = design.F - K @ design.H
    driven = loud.G @ loud.Q @ loud.G.T + K @ loud.R @ K.T
    np.testing.assert_allclose(closed @ settled + settled @ closed.T, -driven, atol=1e-6)


@pytest.mark.parametrize("seed", range(4))
def test_continuous_error_lies_between_the_best_and_the_believed(seed):
    """(4-11) at every time, in the order of positive semidefinite matrices; and as it settles."""
    system = continuous(seed)
    times = np.array([0.0, 0.2, 1.0, 3.0, 60.0])
    bounds = error_bounds_continuous(system, None, COV0, times=times, fading_rate=0.3)
    for k in range(times.size):
        scale = np.abs(bounds.design[k]).max()
        assert smallest(bounds.error[k] - bounds.best[k]) > -1e-7 * scale
        assert smallest(bounds.design[k] - bounds.error[k]) > -1e-7 * scale
    assert smallest(bounds.design[1] - bounds.best[1]) > 0
    steady = steady_state_continuous(system, fading_rate=0.3)
    scale = np.abs(steady.cov).max()
    np.testing.assert_allclose(bounds.error[-1] / scale, steady.error / scale, atol=1e-6)
    np.testing.assert_allclose(
        bounds.best[-1] / scale, steady_state_continuous(system).cov / scale, atol=1e-6
    )


def test_divergence_as_printed_and_as_corrected():
    """REPRODUCTION: at eps = 0.3, t = 20, the white push gives 2.1474, the steady one 9.9252."""
    t, eps = jnp.asarray([20.0]), 0.3
    white = divergence_curve("none", "white", t, eps=eps)
    np.testing.assert_allclose(white, eps / 3 * 21 + 1 / 21 - eps / (3 * 21**2), rtol=1e-12)
    np.testing.assert_allclose(white, 2.1474, atol=5e-5)
    steady = divergence_curve("none", "constant", t, eps=eps)
    np.testing.assert_allclose(steady, 9.9252, atol=5e-5)


@pytest.mark.parametrize("remedy", ["none", "noise", "weighting"])
@pytest.mark.parametrize("push", PUSHES)
def test_divergence_curves_solve_their_equations(remedy, push):
    """(4-2) and (4-9) for (4-12), and the mean error, integrated numerically."""
    eps, setting = 0.3, SETTINGS[remedy]
    rate = setting if remedy == "weighting" else 0.0
    told = setting if remedy == "noise" else 0.0
    noise = eps if push == "white" else 0.0

    def slope(t, y):
        cov, error, bias = y
        return [
            2 * rate * cov - cov**2 + told,
            -2 * cov * error + noise + cov**2,
            -cov * bias + (eps if push == "constant" else 0.0),
        ]

    t = np.linspace(0.0, 20.0, 41)
    y = solve_ivp(slope, (0, 20), [1.0, 1.0, 0.0], "DOP853", t, rtol=1e-12, atol=1e-13).y
    curve = divergence_curve(remedy, push, t, eps=eps, setting=setting)
    np.testing.assert_allclose(curve, y[1] + y[2] ** 2, rtol=1e-8)


def test_weighting_keeps_the_error_bounded():
    """K -> 2 alpha; variance (eps + 4 alpha^2) / (4 alpha); bias eps / (2 alpha)."""
    alpha, eps, late = 0.35, 0.3, jnp.asarray([1e4])
    white = divergence_curve("weighting", "white", late, eps=eps, setting=alpha)
    np.testing.assert_allclose(white, (eps + 4 * alpha**2) / (4 * alpha), rtol=1e-12)
    constant = divergence_curve("weighting", "constant", late, eps=eps, setting=alpha)
    np.testing.assert_allclose(constant, alpha + (eps / (2 * alpha)) ** 2, rtol=1e-12)
    scalar = ContinuousSystem(*(np.array([[x]]) for x in (0.0, 1.0, 1.0, 0.0, 1.0)))
    steady = steady_state_continuous(scalar, fading_rate=alpha)
    np.testing.assert_allclose(steady.gain, [[2 * alpha]], rtol=1e-12)


@pytest.mark.parametrize("remedy", SETTINGS)
@pytest.mark.parametrize("push", PUSHES)
def test_divergence_in_simulation(remedy, push):
    """The sampled filters follow the continuous curves: within 4.5 standard errors and dt."""
    dt, length, eps = 0.05, 12.0, 0.3
    setting = SETTINGS[remedy]
    estimator = divergence_filter(remedy, dt=dt, setting=setting)
    scenario = divergence(push, eps=eps, dt=dt, length=length)
    found = ej.monte_carlo(estimator, None, scenario, runs=1000, key=jax.random.key(1))
    steps = np.array([19, 99, 239])
    t = (steps + 1) * dt
    exact = divergence_curve(remedy, push, t, eps=eps, setting=setting)
    measured, error = (x["squared_error"][steps] for x in (found.per_step, found.per_step_se))
    assert np.all(np.abs(measured - exact) < 4.5 * error + 1.5 * dt * exact)


def test_bad_divergence_settings_are_named():
    for arguments, word in (
        (("some", "white"), "remedy"), (("none", "up"), "push"), (("noise", "white"), "setting")
    ):  # fmt: skip
        with pytest.raises(ValueError, match=word):
            divergence_curve(*arguments, np.ones(1), eps=0.1)
