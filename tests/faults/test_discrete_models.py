"""Constants in `linear_model` over missing rows, gaps, late rows, reports, several steps at once:
what a plain NumPy Kalman filter, one step at a time, or dense least squares gives. Times between
two steps are refused where they are known, and rejected where they are not."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import ewif_jax as ej

F = np.array([[1.0, 1.0], [0.0, 0.9]])
H, R, b = np.array([[1.0, 0.0]]), np.array([[0.5]]), np.array([0.1, -0.2])
Q = 0.1 * np.array([[1 / 3, 0.5], [0.5, 1.0]])
MODEL = ej.linear_model(F, H, R, Q, b)
PRIOR = ej.Gaussian(np.zeros(2), 10 * np.eye(2))
KALMAN = ej.kalman(MODEL)
VALUES = np.array([0.0, 1.1, np.nan, 3.2, 3.9, np.nan, np.nan, 7.2, np.nan, np.nan, 2.0])
PRESENT = np.flatnonzero(np.isfinite(VALUES))
GAPS = ej.stream(PRESENT.astype(float), VALUES[PRESENT])


def stepped(values):
    """Mean, covariance and log likelihood after each row: one prediction for each step of 1."""
    m, P, rows = PRIOR.mean, PRIOR.cov, []
    for k, z in enumerate(values):
        if k:
            m, P = F @ m + b, F @ P @ F.T + Q
        likelihood = 0.0
        if np.isfinite(z):
            S, error = (H @ P @ H.T + R)[0, 0], z - m[0]
            likelihood = -0.5 * (np.log(2 * np.pi * S) + error**2 / S)
            gain = P @ H[0] / S
            m, P = m + gain * error, P - S * np.outer(gain, gain)
        rows.append((m, P, likelihood))
    return [np.array(x) for x in zip(*rows, strict=True)]


def run(stream, estimator=KALMAN, params=None, **options):
    return ej.run(estimator, params, stream, **{"prior": PRIOR, "t0": 0.0, **options})


@pytest.mark.parametrize("rows", ["masked", "absent"])
def test_rows_that_are_missing(rows):
    mean, cov, likelihood = stepped(VALUES)
    kept = np.arange(VALUES.size) if rows == "masked" else PRESENT
    stream = ej.stream(kept.astype(float), VALUES[kept])
    trace = run(stream)
    np.testing.assert_allclose(trace.mean, mean[kept], rtol=1e-11, atol=1e-12)
    np.testing.assert_allclose(trace.cov, cov[kept], rtol=1e-11, atol=1e-12)
    np.testing.assert_allclose(trace.info.log_likelihood, likelihood[kept], rtol=1e-11)
    smoothed = ej.rts(MODEL, None, stream, prior=PRIOR, t0=0.0)
    np.testing.assert_allclose(smoothed.mean[-1], mean[-1], rtol=1e-11)
    np.testing.assert_allclose(smoothed.cov[-1], cov[-1], rtol=1e-11)


def test_smoothers_sort_and_a_late_row_is_as_if_in_time():
    order = np.array([0, 1, 4, 2, 3])
    late = ej.stream(PRESENT[order].astype(float), VALUES[PRESENT[order]])
    mean, cov, _ = stepped(VALUES[: PRESENT[4] + 1])
    smoothed = ej.rts(MODEL, None, late, prior=PRIOR, t0=0.0)
    np.testing.assert_allclose(smoothed.mean[2], mean[-1], rtol=1e-11)
    replayed = run(late, ej.replay(KALMAN, 4))
    np.testing.assert_allclose(replayed.mean[-1], mean[-1], rtol=1e-10)
    np.testing.assert_allclose(replayed.cov[-1], cov[-1], rtol=1e-10)


def test_reports_are_forecasts_of_several_steps():
    mean, cov, _ = stepped(np.append(VALUES, [np.nan] * 5))
    trace = run(GAPS, times=PRESENT + 5.0)
    np.testing.assert_allclose(trace.mean[-1], mean[-1], rtol=1e-11)
    np.testing.assert_allclose(trace.cov[-1], cov[-1], rtol=1e-11)


def test_fading_forgets_at_every_step():
    """Without process noise a gap of k steps inflates by alpha^(2k), however it is cut."""
    fading = ej.fading(ej.linear_model(F, H, R, None, b), 1.1)
    cut = run(ej.stream(np.arange(11.0), VALUES), fading)
    for found, expected in zip(run(GAPS, fading)[1:3], cut[1:3], strict=True):
        np.testing.assert_allclose(found, expected[PRESENT], rtol=1e-9)
    model = ej.linear_model(F, H, R, Q)
    alone = run(ej.stream([3.0], [np.nan]), ej.fading(model, 1.1)).cov[0]
    noise = F @ (F @ Q @ F.T + Q) @ F.T + Q
    moved = np.linalg.matrix_power(F, 3)
    np.testing.assert_allclose(alone, 1.1**6 * moved @ PRIOR.cov @ moved.T + noise, rtol=1e-11)


def test_least_squares_over_several_steps():
    """A measurement two steps late, a window, and all at once: dense least squares."""
    model, t = ej.linear_model(np.array([[1.0, 1.0], [0.0, 1.0]]), H, np.eye(1)), np.arange(12.0)
    z = 0.7 * t + np.random.default_rng(1).normal(size=12)

    def dense(weights):
        rows = np.stack([np.ones_like(t), t - 11], 1)
        return np.linalg.solve(rows.T @ (weights[:, None] * rows), rows.T @ (weights * z))

    late, old = np.array([0, 1, 2, 3, 4, 5, 6, 7, 8, 10, 11, 9]), np.exp((t - 11) / 3)
    shuffled, window = ej.stream(t[late], z[late]), (t > 6.5).astype(float)
    found = run(shuffled, ej.ewif(model, 3.0), prior=None).mean[-1]
    np.testing.assert_allclose(found, dense(old), rtol=1e-9)
    found = run(ej.stream(t, z), ej.limited_memory(model, 4.5, 8), prior=None).mean[-1]
    np.testing.assert_allclose(found, dense(window), rtol=1e-9)

    def weight(params, measured, at):
        return jnp.exp((measured - at) / 6)

    found = ej.batch_wls(model, None, shuffled, t[-1:], weight=weight).mean[0]
    np.testing.assert_allclose(found, dense(old), rtol=1e-9)
    found = ej.two_sided_ewif(model, None, shuffled, tau=3.0, times=t[-1:]).mean[0]
    np.testing.assert_allclose(found, dense(old), rtol=1e-9)


HALF = ej.stream([1.0, 2.5, 3.0], [1.0, 2.0, 3.0])
TWO = HALF._replace(value=np.ones((2, 3, 1)), time=np.array([[1.0, 2, 3], [1, 2, 3.4]]))
TWO = TWO._replace(mask=np.ones((2, 3, 1), bool))
AT_EDGE = ej.stream([2.0**22], np.ones(1, np.float32))
REFUSED = {
    "run": (lambda: run(HALF), "2.5 at row 1 .1.5 s after"),
    "t0": (lambda: run(HALF, t0=0.5), "1 at row 0"),
    "report": (lambda: run(ej.stream([1.0], [1.0]), times=np.array([1.5])), "times: .* whole"),
    "run_batch": (
        lambda: ej.run_batch(KALMAN, None, TWO, prior=PRIOR, t0=0.0),
        "3.4 at row 2 of run 1",
    ),
    "run_parallel": (
        lambda: ej.run_parallel(MODEL, None, HALF, tau=2.0, prior=None, t0=0.0),
        "2.5 at row 1",
    ),
    "step": (
        lambda: ej.step(
            KALMAN, None, KALMAN.init(None, PRIOR, 0.0), jax.tree.map(lambda x: x[1], HALF)
        ),
        "2.5 at row 0",
    ),
    "rts": (lambda: ej.rts(MODEL, None, HALF, prior=PRIOR, t0=0.0), "median interval"),
    "batch_wls": (
        lambda: ej.batch_wls(MODEL, None, HALF, [1.0], weight=lambda p, a, b: 1.0),
        "from_continuous",
    ),
    "two_sided_ewif": (lambda: ej.two_sided_ewif(MODEL, None, HALF, tau=1.0), "dt = 1 s"),
    "far": (lambda: run(ej.stream([2000.0], [1.0])), "max_steps = 1023"),
    "not countable": (lambda: run(AT_EDGE, t0=2.0**22), "float32 can count"),
    "Q beside intervals": (
        lambda: ej.linear_model(lambda p, t0, t1: jnp.eye(2), H, R, Q),
        "Q: expected a function of",
    ),
    "no way back": (lambda: ej.ewif(ej.linear_model(np.diag([1.0, 0]), H, R), 1.0), "inverse"),
    "dt": (lambda: ej.linear_model(F, H, R, dt=0.0), "dt"),
    "lag": (
        lambda: ej.fixed_lag_ewif(ej.linear_model(F, H, R), 1.0, lag=1.5),
        "lag: expected whole steps of dt = 1 s",
    ),
    "lag of params": (
        lambda: run(
            ej.stream([1.0], [1.0]),
            ej.fixed_lag_ewif(ej.linear_model(F, H, R), 1.0, lag=lambda p: p["lag"]),
            {"lag": 0.5},
        ),
        "lag: expected whole steps of dt = 1 s",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_known_times_between_steps_are_refused(name):
    call, words = REFUSED[name]
    with pytest.raises(ValueError, match=words):
        call()


def test_traced_times_between_steps_are_rejected():
    """Neither state nor time moves, and the next whole row is used; derivatives are finite."""
    values = np.array([1.1, 5.0, 3.2])
    estimator = ej.kalman(ej.linear_model(F, H, R, lambda p: p * Q, b))

    def found(times, q):
        return run(ej.stream(times, values), estimator, q)

    trace = jax.jit(found)(jnp.array([1.0, 2.4, 3.0]), 1.0)
    without = run(ej.stream([1.0, 3.0], values[[0, 2]]))
    np.testing.assert_array_equal(trace.info.status, [0, ej.Status.REJECTED, 0])
    np.testing.assert_allclose(trace.time, [1.0, 1.0, 3.0])
    np.testing.assert_allclose(trace.info.delay, [0.0, -1.4, 0.0])
    np.testing.assert_allclose(trace.info.log_likelihood[1], 0.0)
    np.testing.assert_allclose(trace.mean, np.asarray(without.mean)[[0, 0, 1]], rtol=1e-11)
    slopes = jax.jit(jax.grad(lambda *x: found(*x).info.log_likelihood.sum(), (0, 1)))
    by_time, by_q = slopes(jnp.array([1.0, 2.4, 3.0]), 1.0)
    np.testing.assert_array_equal(by_time, np.zeros(3))
    assert np.isfinite(by_q)
    assert by_q != 0


def test_stamps_that_jitter_are_whole():
    """Each is within 0.01 of its step, the intervals between them are not."""
    times = np.arange(1.0, 11.0) + 0.009 * (-1.0) ** np.arange(10)
    trace = run(ej.stream(times, VALUES[:10]))
    mean, _, _ = stepped(np.append(np.nan, VALUES[:10]))
    np.testing.assert_allclose(trace.mean, mean[1:], rtol=1e-11, atol=1e-12)


def test_what_stands_still_does_so_over_any_interval():
    model = ej.linear_model(np.eye(2), np.eye(2), np.eye(2))
    trace = run(ej.stream([0.1, 7.77], np.ones((2, 2))), ej.kalman(model))
    np.testing.assert_allclose(trace.mean[-1], np.full(2, 2 / 2.1), rtol=1e-12)
