"""The oracles agree with each other, with closed forms and with reproduced published numbers."""

import math

import numpy as np
import pytest
from scipy.optimize import minimize_scalar
from scipy.signal import savgol_coeffs

from .dense import trajectory_map
from .expected_mse import (
    bias_and_cov,
    ewif_estimator,
    expected_mse,
    kalman_estimator,
    linear_operator,
    sine,
)
from .joint_gaussian import joint, log_likelihood, posterior
from .kalman_loop import actual_error, fading_filter, kalman_filter, weighted_cost_minimiser
from .late import (
    Interval,
    al1,
    al1_as_kalman_update,
    bl1,
    cutoff_delay,
    delayed_gain,
    ideal_gains,
    lag_interval,
    selective_filter,
    steady_gain,
)
from .limited_memory import limited_memory
from .wls import (
    batch_wls,
    ewif_weight,
    savgol_coefficients,
    symmetric_weight,
    true_cov,
    window_weight,
)


def F(t0, t1):
    return np.array([[1.0, t1 - t0], [0.0, 1.0]])


def b(t0, t1):
    """Return the effect of a constant acceleration of 0.7."""
    return 0.7 * np.array([(t1 - t0) ** 2 / 2.0, t1 - t0])


def Q(t0, t1):
    """Return white-noise acceleration, which composes over sub-intervals."""
    dt = abs(t1 - t0)
    return 0.3 * np.array([[dt**3 / 3.0, dt**2 / 2.0], [dt**2 / 2.0, dt]])


def no_noise(t0, t1):
    return np.zeros((2, 2))


def back(t_l, t):
    return F(t, t_l)


def back_offset(t_l, t):
    return b(t, t_l)


@pytest.fixture
def data():
    """Irregular times with a repeat, two components of which some are masked, and an input."""
    rng = np.random.default_rng(3)
    times = np.sort(np.round(rng.uniform(0.0, 4.0, 12), 2))
    times[5] = times[4]
    masks = rng.uniform(size=(12, 2)) > 0.3
    masks[[0, 1]], masks[7] = True, False
    L = rng.normal(size=(12, 2, 2))
    return {
        "times": times,
        "H": list(rng.normal(size=(12, 2, 2))),
        "R": list(L @ L.transpose(0, 2, 1) + 0.2 * np.eye(2)),
        "values": list(rng.normal(size=(12, 2))),
        "masks": masks,
    }


PRIOR = {"t0": 0.0, "prior_mean": np.array([0.4, -1.0]), "prior_cov": np.diag([2.0, 0.5])}


def permuted(data, order):
    return {name: [entry[k] for k in order] for name, entry in data.items()}


def close(actual, expected, rtol=1e-9, atol=1e-11):
    for a, e in zip(actual, expected, strict=True):
        np.testing.assert_allclose(a, e, rtol=rtol, atol=atol)


# --- joint Gaussian, Kalman loop ------------------------------------------------------------


def test_joint_gaussian_is_the_kalman_loop_in_sequence(data):
    track = kalman_filter(**PRIOR, F=F, Q=Q, b=b, **data)
    total = log_likelihood(**PRIOR, F=F, Q=Q, b=b, **data)
    np.testing.assert_allclose(track.log_likelihoods.sum(), total)
    for k in (0, 5, 7, 11):
        first = permuted(data, range(k + 1))
        exact = posterior(data["times"][k], **PRIOR, F=F, Q=Q, b=b, **first)
        close(exact, (track.means[k], track.covs[k]))


def test_joint_gaussian_ignores_arrival_order(data):
    shuffled = permuted(data, np.random.default_rng(0).permutation(12))
    args = {**PRIOR, "F": F, "Q": Q, "b": b}
    close(posterior(2.2, **args, **shuffled), posterior(2.2, **args, **data))


def test_joint_gaussian_has_the_moments_of_the_process():
    grid, mean, cov = joint([1.0, 2.5], **PRIOR, F=F, Q=Q, b=b)
    P1 = F(0, 1) @ PRIOR["prior_cov"] @ F(0, 1).T + Q(0, 1)
    assert grid.tolist() == [0.0, 1.0, 2.5]
    np.testing.assert_allclose(cov[2:4, 2:4], P1)
    np.testing.assert_allclose(cov[4:, 2:4], F(1, 2.5) @ P1)
    np.testing.assert_allclose(mean[4:], F(0, 2.5) @ PRIOR["prior_mean"] + b(0, 2.5))
    close([cov[4:, 4:]], [F(0, 2.5) @ PRIOR["prior_cov"] @ F(0, 2.5).T + Q(0, 2.5)])


def test_joint_gaussian_without_data_is_the_prediction():
    empty = {"times": [], "H": [], "R": [], "values": []}
    mean, cov = posterior(2.0, **PRIOR, F=F, Q=Q, **empty)
    np.testing.assert_allclose(mean, F(0, 2.0) @ PRIOR["prior_mean"])
    np.testing.assert_allclose(cov, F(0, 2.0) @ PRIOR["prior_cov"] @ F(0, 2.0).T + Q(0, 2.0))
    assert log_likelihood(**PRIOR, F=F, Q=Q, **empty) == 0.0


def test_times_before_t0_and_unsorted_loops_are_refused(data):
    with pytest.raises(ValueError, match="earlier than t0"):
        posterior(-1.0, **PRIOR, F=F, Q=Q, **data)
    with pytest.raises(ValueError, match="backwards"):
        kalman_filter(**PRIOR, F=F, Q=Q, **permuted(data, [3, 0]))


# --- Anderson -------------------------------------------------------------------------------


def test_fading_loop_minimises_the_weighted_cost(data):
    alphas = np.random.default_rng(1).uniform(1.0, 1.4, 12)
    args = {**PRIOR, "F": F, "Q": Q, "b": b, "alphas": alphas, **data}
    track = fading_filter(**args)
    states, Pi = weighted_cost_minimiser(**args)
    close([states[-1], Pi], [track.means[-1], track.covs[-1]])


def test_unweighted_cost_minimiser_is_the_exact_smoother(data):
    states, _ = weighted_cost_minimiser(**PRIOR, F=F, Q=Q, b=b, alphas=np.ones(12), **data)
    for k in (0, 4, 12):
        t = [0.0, *data["times"]][k]
        close([states[k]], [posterior(t, **PRIOR, F=F, Q=Q, b=b, **data)[0]])


def test_fading_with_exponential_alpha_and_vague_prior_is_the_ewif(data):
    tau, times = 0.8, data["times"]
    alphas = np.exp(np.diff(times, prepend=0.0) / (2.0 * tau))
    vague = {**PRIOR, "prior_cov": 1e7 * np.eye(2)}
    track = fading_filter(**vague, F=F, Q=no_noise, b=b, alphas=alphas, **data)
    weight = ewif_weight(tau)
    for k in (5, 11):
        first = permuted(data, range(k + 1))
        batch = batch_wls(times[k], back, back_offset, weight=weight, **first)
        close((track.means[k], track.covs[k]), batch, rtol=1e-5, atol=1e-6)


def test_fading_with_exponential_alpha_and_prior_is_the_weighted_batch(data):
    tau, times = 0.8, data["times"]
    alphas = np.exp(np.diff(times, prepend=0.0) / (2.0 * tau))
    track = fading_filter(**PRIOR, F=F, Q=no_noise, b=b, alphas=alphas, **data)
    prior = (PRIOR["prior_mean"], PRIOR["prior_cov"], 0.0)
    batch = batch_wls(times[-1], back, back_offset, weight=ewif_weight(tau), prior=prior, **data)
    close((track.means[-1], track.covs[-1]), batch)


def test_actual_error_lies_between_optimal_and_designed(data):
    system = {"F": F, "Q": Q, **{name: data[name] for name in ("times", "H", "R")}}
    optimal = kalman_filter(**PRIOR, F=F, Q=Q, b=b, **data)
    faded = fading_filter(**PRIOR, F=F, Q=Q, b=b, alphas=np.full(12, 1.2), **data)
    start = {"t0": 0.0, "prior_cov": PRIOR["prior_cov"]}
    close([actual_error(**start, **system, gains=optimal.gains)], [optimal.covs])
    E = actual_error(**start, **system, gains=faded.gains)
    assert np.linalg.eigvalsh(E - optimal.covs).min() > -1e-12
    assert np.linalg.eigvalsh(faded.covs - E).min() > -1e-12


# --- weighted least squares -----------------------------------------------------------------


def test_recursive_theorem_3_and_fixed_lag_theorem_5_are_the_batch(data):
    tau, times = 0.8, data["times"]
    args = {"A": back, "offset": back_offset, "weight": ewif_weight(tau), **data}
    mean, cov = batch_wls(times[-1], **args)
    earlier = times[-1] - 1.3
    lagged = F(times[-1], earlier)
    expected = lagged @ mean + b(times[-1], earlier), np.exp(-1.3 / tau) * lagged @ cov @ lagged.T
    close(batch_wls(earlier, **args), expected)


def test_true_cov_of_the_static_scalar():
    dt, tau, R = 0.1, 0.5, 0.7
    times = dt * np.arange(200)
    rho = np.exp(-dt / tau)
    H, Rs, values = [1.0] * 200, [R] * 200, [0.0] * 200
    args = (times[-1], lambda t_l, t: 1.0)
    _, P = batch_wls(*args, None, times, H, Rs, values, ewif_weight(tau))
    np.testing.assert_allclose(P.item(), R * (1 - rho))
    E = true_cov(*args, times, H, Rs, ewif_weight(tau))
    np.testing.assert_allclose(E.item(), R * (1 - rho) / (1 + rho))


@pytest.mark.parametrize("weight", [ewif_weight(0.5), symmetric_weight(0.5), window_weight(2.0)])
def test_true_cov_is_the_covariance_of_the_linear_map(data, weight):
    t, system = 2.5, {name: data[name] for name in ("times", "H", "R", "masks")}
    m = data["masks"].size

    def estimate(z):
        mean, _ = batch_wls(t, back, None, values=z.reshape(12, 2), weight=weight, **system)
        return mean

    L = np.stack([estimate(unit) for unit in np.eye(m)], axis=1)
    blocks = [L[:, 2 * k : 2 * k + 2] @ data["R"][k] @ L[:, 2 * k : 2 * k + 2].T for k in range(12)]
    close([true_cov(t, back, weight=weight, **system)], [sum(blocks)])


def test_unobservable_state_is_refused():
    with pytest.raises(np.linalg.LinAlgError, match="determine"):
        batch_wls(0.0, back, None, [0.0], [[[1.0, 0.0]]], [1.0], [1.0], ewif_weight(1.0))


@pytest.mark.parametrize(
    ("length", "order", "deriv", "delta", "pos"),
    [(7, 2, 0, 1.0, None), (9, 3, 1, 0.1, 8), (5, 2, 2, 0.5, 0), (6, 3, 1, 2.0, None)],
)
def test_savgol_coefficients_are_scipys(length, order, deriv, delta, pos):
    ours = savgol_coefficients(length, order, deriv, delta, pos)
    theirs = savgol_coeffs(length, order, deriv=deriv, delta=delta, pos=pos, use="dot")
    np.testing.assert_allclose(ours, theirs, rtol=1e-8, atol=1e-10)


def test_limited_memory_is_savgol_for_a_straight_line():
    times = 0.1 * np.arange(30)
    values = np.random.default_rng(2).normal(size=30)
    args = (times, [[[1.0, 0.0]]] * 30, [0.3] * 30, values)
    mean, _ = limited_memory(times[20], 0.65, back, None, *args)
    position = savgol_coefficients(7, 1, 0, 0.1, pos=6) @ values[14:21]
    velocity = savgol_coefficients(7, 1, 1, 0.1, pos=6) @ values[14:21]
    np.testing.assert_allclose(mean, [position, velocity])
    centre, _ = batch_wls(times[17], back, None, *args, weight=window_weight(0.35))
    np.testing.assert_allclose(centre[0], savgol_coefficients(7, 1) @ values[14:21])


# --- exact expected error -------------------------------------------------------------------


def test_estimators_of_expected_mse_are_the_other_oracles(data):
    H, R, times = data["H"], data["R"], data["times"]
    values = np.array(data["values"])
    ewif = ewif_estimator(times, back, H, R, tau=0.8)(values)
    batch, _ = batch_wls(times[-1], back, None, times, H, R, values, ewif_weight(0.8))
    np.testing.assert_allclose(ewif[-1], batch)
    kalman = kalman_estimator(times, F, Q, H, R)(values)
    start = np.linalg.inv(H[0])
    track = kalman_filter(
        t0=times[0],
        prior_mean=start @ values[0],
        prior_cov=start @ R[0] @ start.T,
        F=F,
        Q=Q,
        times=times[1:],
        H=H[1:],
        R=R[1:],
        values=values[1:],
    )
    np.testing.assert_allclose(kalman[1:], track.means)


def test_linear_operator_of_a_loop_with_input_and_prior(data):
    def estimate(values):
        return kalman_filter(**PRIOR, F=F, Q=Q, b=b, **{**data, "values": values}).means

    L, c = linear_operator(estimate, 12, 2)
    values = np.array(data["values"])
    np.testing.assert_allclose(L @ values.ravel() + c, estimate(values))


def test_ewif_error_covariance_is_the_sandwich(data):
    H, R, times = data["H"], data["R"], data["times"]
    estimator = ewif_estimator(times, back, H, R, tau=0.8)
    _, cov = bias_and_cov(estimator, np.zeros((12, 2)), R, np.zeros((12, 2)))
    np.testing.assert_allclose(cov[-1], true_cov(times[-1], back, times, H, R, ewif_weight(0.8)))


def test_expected_mse_counts_the_pull_of_the_prior():
    gain, prior_mean, truth, r = 0.3, 2.0, 5.0, 0.7

    def estimate(values):
        return prior_mean + gain * (values - prior_mean)

    mse = expected_mse(estimate, [[truth]], [r], [[truth]])
    np.testing.assert_allclose(mse, [((1 - gain) * (prior_mean - truth)) ** 2 + gain**2 * r])


def random_walk_rmse(times, truth, *, tau=None, sigma_w=None, r=0.5):
    """Return the root of the time-averaged expected MSE of the scalar EWIF or Kalman filter."""
    ones, noise = np.ones(len(times)), np.full(len(times), r)

    def still(t0, t1):
        return 1.0

    if tau is not None:
        estimator = ewif_estimator(times, still, ones, noise, tau)
    else:
        estimator = kalman_estimator(times, still, lambda t0, t1: sigma_w**2, ones, noise)
    return math.sqrt(expected_mse(estimator, truth[:, None], noise, truth[:, None]).mean())


@pytest.mark.parametrize(
    ("omega", "dt", "length", "ewif", "kalman"),
    [
        (0.2 * np.pi, 0.1, 10.0, 0.3001, 0.3196),
        (0.2 * np.pi, 0.1, 20.0, 0.2971, 0.3232),
        (1.0, 0.1, 10.0, 0.3641, 0.4140),
        (0.7, 0.09, 10.0, 0.3097, 0.3309),
    ],
)
def test_sine_of_section_v_c(omega, dt, length, ewif, kalman):
    times, truth = sine(1.0, omega / (2.0 * np.pi), dt, length)
    np.testing.assert_allclose(random_walk_rmse(times, truth, tau=0.5), ewif, atol=6e-5)
    np.testing.assert_allclose(random_walk_rmse(times, truth, sigma_w=0.1), kalman, atol=6e-5)


@pytest.mark.parametrize(
    ("name", "best", "value"), [("tau", 0.4668, 0.29964), ("sigma_w", 0.1541, 0.29958)]
)
def test_sine_optimum(name, best, value):
    times, truth = sine(1.0, 0.1, 0.1, 10.0)
    assert len(times) == 101
    found = minimize_scalar(
        lambda x: random_walk_rmse(times, truth, **{name: x}),
        bounds=(0.5 * best, 2.0 * best),
        method="bounded",
        options={"xatol": 1e-5},
    )
    np.testing.assert_allclose(found.x, best, atol=6e-5)
    np.testing.assert_allclose(found.fun, value, atol=6e-6)


def test_random_walk_gain_equals_the_ewif_gain():
    k = steady_gain(1.0, 1.0, 0.1**2, 0.5).item()
    np.testing.assert_allclose(-0.1 / math.log(1.0 - k), 0.7077, atol=5e-5)
    k = 1.0 - math.exp(-0.1 / 0.5)
    sigma_w = math.sqrt(0.5 * k**2 / (1.0 - k))
    np.testing.assert_allclose(sigma_w, 0.14166, atol=5e-6)
    np.testing.assert_allclose(steady_gain(1.0, 1.0, sigma_w**2, 0.5).item(), k)


# --- late measurements ----------------------------------------------------------------------


def one_late(data, lags, t_late):
    """Return the estimate without the last value, its Al1 interval, and the value taken late."""
    first = permuted(data, range(11))
    track = kalman_filter(**PRIOR, F=F, Q=Q, b=b, **first)
    times, k = data["times"], 10 - lags
    lag = lag_interval(times[k], track.means[k], track.covs[k], t_late, times[10], F=F, Q=Q, b=b)
    late = data["H"][11], data["R"][11], data["values"][11]
    return first, (track.means[10], track.covs[10], lag, *late)


def test_al1_at_one_lag_is_exact(data):
    times = data["times"]
    t_late = 0.3 * times[9] + 0.7 * times[10]
    first, arguments = one_late(data, 1, t_late)
    everything = {name: [*first[name], data[name][11]] for name in first}
    everything["times"][-1], everything["masks"][-1] = t_late, [True, True]
    exact = posterior(times[10], **PRIOR, F=F, Q=Q, b=b, **everything)
    close(al1(*arguments), exact)


@pytest.mark.parametrize("lags", [1, 3])
def test_al1_is_one_kalman_update(data, lags):
    times = data["times"]
    _, arguments = one_late(data, lags, times[10 - lags] + 0.01)
    close(al1(*arguments), al1_as_kalman_update(*arguments))


def test_al1_ignores_the_order_of_two_late_values(data):
    times = data["times"]
    _, (mean, cov, lag, *late) = one_late(data, 3, times[7] + 0.01)
    other_lag = Interval(*lag[:2], F(times[10] - 0.02, times[10]), *lag[3:])
    other_lag = other_lag._replace(Q=Q(times[10] - 0.02, times[10]), b=b(0.0, 0.02))
    other = [[0.5, 1.0]], 0.4, 2.0
    one = al1(*al1(mean, cov, lag, *late), other_lag, *other)
    two = al1(*al1(mean, cov, other_lag, *other), lag, *late)
    close(one, two)


@pytest.mark.parametrize("rule", [al1, bl1])
def test_late_rules_at_zero_delay_are_the_in_sequence_update(data, rule):
    _, (mean, cov, lag, H, R, value) = one_late(data, 1, data["times"][10])
    K = cov @ H.T @ np.linalg.inv(H @ cov @ H.T + R)
    close(rule(mean, cov, lag, H, R, value), (mean + K @ (value - H @ mean), cov - K @ H @ cov))


def random_walk_late(rule, steps, lags, q=1.0, r=1.0):
    """Return (true variance, reported variance, exact variance, variance without the late value).

    A long random walk observed at 0, 1, ..., and a value at mid-interval, `lags` back, comes last.
    """
    t_late = steps - lags + 0.5
    times = [*range(1, steps + 1), t_late]
    prior = {"t0": 0.0, "prior_mean": 0.0, "prior_cov": 2.0}
    model = {"F": lambda t0, t1: 1.0, "Q": lambda t0, t1: q * (t1 - t0)}

    def estimate(z):
        in_sequence = {"times": times[:-1], "H": [1.0] * steps, "R": [r] * steps}
        track = kalman_filter(**prior, **model, **in_sequence, values=list(z[:-1]))
        k = steps - lags - 1
        lag = lag_interval(times[k], track.means[k], track.covs[k], t_late, steps, **model)
        mean, cov = rule(track.means[-1], track.covs[-1], lag, 1.0, r, z[-1])
        return mean.item(), cov.item(), track.covs[-1].item()

    m = steps + 1
    start, reported, dropped = estimate(np.zeros(m))
    L = np.array([estimate(unit)[0] - start for unit in np.eye(m)])
    grid, _, cov = joint(times, **prior, **model)
    H = (np.array(times)[:, None] == grid).astype(float)
    error = (grid == steps).astype(float) - L @ H
    true = error @ cov @ error + r * L @ L
    measured = {"times": times, "H": [1.0] * m, "R": [r] * m, "values": [0.0] * m}
    exact = posterior(steps, **prior, **model, **measured)[1].item()
    return true, reported, exact, dropped


@pytest.mark.parametrize(
    ("lags", "drop", "with_al1"), [(1, 1.219, 1.0), (2, 1.028, 1.009), (3, 1.004, 1.014)]
)
def test_al1_against_the_exact_error(lags, drop, with_al1):
    true, _, exact, dropped = random_walk_late(al1, 25, lags)
    np.testing.assert_allclose([dropped / exact, true / exact], [drop, with_al1], atol=6e-4)


def test_covariances_of_al1_and_bl1():
    true, reported, *_ = random_walk_late(al1, 25, 3)
    assert reported < true
    true, reported, *_ = random_walk_late(bl1, 25, 1)
    np.testing.assert_allclose(reported, true)


def test_published_cutoff_delays():
    np.testing.assert_allclose(
        cutoff_delay(math.sqrt(20.0), math.sqrt(2000.0), 1.0, 0.6), 5.1104, atol=5e-5
    )
    found = [cutoff_delay(sigma_q, 50.0, 0.2, 0.6) for sigma_q in (0.5, 5.0, 50.0, 500.0)]
    np.testing.assert_allclose(found, [22.845, 2.2847, 0.2303, 0.0331], rtol=2e-3)


def test_delayed_gain_is_the_gain_of_reprocessing():
    """The loop's estimate moves by the delayed gain when an old value moves by one."""
    dt, lag = 0.5, 4
    args = {"F": F, "Q": Q, "t0": 0.0, "prior_mean": np.zeros(2), "prior_cov": np.eye(2)}
    times = dt * np.arange(1, 81)
    args |= {"times": times, "H": [[[1.0, 0.0]]] * 80, "R": [0.4] * 80}
    values = np.zeros(80)
    before = kalman_filter(**args, values=values).means[-1]
    values[-1 - lag] = 1.0
    moved = kalman_filter(**args, values=values).means[-1] - before
    expected = delayed_gain(F(0, dt), [[1.0, 0.0]], Q(0, dt), 0.4, lag)
    np.testing.assert_allclose(moved, expected[:, 0], atol=1e-12)


def test_steady_gain_is_yoders_closed_forms():
    for index in (0.05, 1.0, 5.0):
        k = (-(index**2) + math.sqrt(index**4 + 4.0 * index**2)) / 2.0
        np.testing.assert_allclose(steady_gain(1.0, 1.0, index**2, 1.0).item(), k)
        G = np.array([[0.5], [1.0]])
        root = math.sqrt(index**2 + 8.0 * index)
        alpha = (-(index**2) - 8.0 * index + (index + 4.0) * root) / 8.0
        beta = (index**2 + 4.0 * index - index * root) / 4.0
        gain = steady_gain(F(0, 1), [[1.0, 0.0]], index**2 * G @ G.T, 1.0)
        np.testing.assert_allclose(gain[:, 0], [alpha, beta], rtol=1e-9)


def test_algorithm_1_is_the_linear_operator_of_the_loop():
    intervals, h, first_cov = [0.3, 0.1, 0.7, 0.2], 1.7, 2.5
    times = np.cumsum([0.0, *intervals])
    gains = ideal_gains(intervals, sigma_q=0.8, sigma_r=1.1, first_cov=first_cov, h=h)

    def estimate(values, start=0.0):
        return kalman_filter(
            t0=0.0,
            prior_mean=start,
            prior_cov=first_cov,
            F=lambda t0, t1: 1.0,
            Q=lambda t0, t1: 0.8**2 * (t1 - t0),
            times=times,
            H=[h] * 5,
            R=[1.1**2] * 5,
            values=values,
        ).means

    L, _ = linear_operator(estimate, 5, 1)
    start = estimate(np.zeros((5, 1)), 1.0)[:, 0]
    for j in range(1, 6):
        np.testing.assert_allclose(gains[j - 1, :j], L[j - 1, 0, :j][::-1])
        np.testing.assert_allclose(gains[j - 1, j], start[j - 1])
        assert not gains[j - 1, j + 1 :].any()


def test_selective_filter_keeps_a_running_maximum():
    used_up, used = selective_filter(
        lambda seen, k: [*seen, k], [], [0.0, 2.0, 1.5, 1.0, 1.2, 3.0, 2.0], max_delay=1.0
    )
    assert used == [True, True, True, False, True, True, False]
    assert used_up == [0, 1, 2, 4, 5]


def test_trajectory_map_is_the_recursion():
    T = trajectory_map([F(0, 1), F(0, 2)], 2)
    np.testing.assert_allclose(T[4:, :2], F(0, 2) @ F(0, 1))
    np.testing.assert_allclose(T[4:, 2:4], F(0, 2))
