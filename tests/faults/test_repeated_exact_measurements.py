"""What is known exactly already is measured exactly again: nothing is learnt, in every form.

The limit of a small R gives no likelihood (it grows or falls without bound); the density of what is
left free is 0 for a component that is not free. The oracle is Kalman's recursion in NumPy that
leaves out the directions in which the innovation covariance is zero.
"""

from functools import cache

import jax
import numpy as np
import pytest

import ewif_jax as ej

RNG = np.random.default_rng(0)
SEEN = {"one axis each": np.eye(3)[:2], "oblique": RNG.normal(size=(2, 3))}
ROOT = RNG.normal(size=(3, 3))
PRIOR = ej.Gaussian(RNG.normal(size=3), ROOT @ ROOT.T + 0.3 * np.eye(3))
STILL, CHAIN = np.zeros((3, 3)), np.diag([1.0, 1.0], 1)
DRIVEN = np.diag([0.1, 0.2, 0.3])
CASES = {
    "no noise": (np.zeros((2, 2)), STILL, DRIVEN, [1.0, 1, 2, 3]),
    "one exact component": (np.diag([0.0, 0.5]), STILL, DRIVEN, [1.0, 1, 2, 2]),
    "rank one": (np.outer([1, 0.5], [1, 0.5]), STILL, DRIVEN, [1.0, 1, 2, 3]),
    "motion without noise": (np.zeros((2, 2)), CHAIN, STILL, [1.0, 2, 3, 4]),
    "nothing moves": (np.zeros((2, 2)), STILL, STILL, [1.0, 2, 3, 4]),
}


def linear():
    return ej.linear_model(
        lambda p, a, b: np.eye(3) + (b - a) * p["slope"],
        lambda p, s, t: p["H"],
        lambda p, s, t: p["R"],
        lambda p, a, b: (b - a) * p["Q"],
    )


def functions_only():
    model = linear()
    return ej.Model(
        model.transition, model.process_cov, lambda p, x, s, t: p["H"] @ x, model.measurement_cov
    )


FILTERS = {
    "kalman": lambda: ej.kalman(linear()),
    "information": lambda: ej.information(linear()),
    "asd": lambda: ej.asd(linear(), 4),
    "unscented": lambda: ej.unscented(functions_only()),
}
OTHERS = {
    "extended": lambda: ej.extended(functions_only()),
    "fading": lambda: ej.fading(linear(), 1.0),
    "al1": lambda: ej.al1(linear(), 4),
    "bl1": lambda: ej.bl1(linear(), 4),
    "rts_reference": lambda: ej.rts_reference(linear(), 4),
    "replay": lambda: ej.replay(ej.kalman(linear()), 4),
}


@cache
def ran(name):
    method = {**FILTERS, **OTHERS}[name]()

    def run(params, measurements):
        return ej.run(method, params, measurements, prior=PRIOR, t0=0.0)

    return jax.jit(run)


def world(sight, case):
    """Parameters and a stream whose repeated rows say the same again where they are exact."""
    (R, slope, Q, times), H = CASES[case], SEEN[sight]
    rng = np.random.default_rng(1)
    x, now, values, noise = rng.multivariate_normal(*PRIOR), 0.0, [], np.linalg.cholesky
    root = np.linalg.svd(R)[0] * np.sqrt(np.linalg.svd(R)[1])
    for time in times:
        dt = time - now
        x, now = (np.eye(3) + dt * slope) @ x, time
        if dt and Q.any():
            x = x + noise(dt * Q) @ rng.normal(size=3)
        values.append(H @ x + root @ rng.normal(size=2))
    return {"H": H, "R": R, "slope": slope, "Q": Q}, ej.stream(times, np.array(values))


def filtered(params, stream):
    """Mean, covariance and log density of each row."""
    H, R, (x, P), now, found = params["H"], params["R"], PRIOR, 0.0, []
    # Beyond the values whose exactness is judged, by which the units of the two are compared.
    least = 1e-10 * np.linalg.norm(PRIOR.cov)
    for time, value in zip(np.asarray(stream.time), np.asarray(stream.value), strict=True):
        F = np.eye(3) + (time - now) * params["slope"]
        x, P, now = F @ x, F @ P @ F.T + (time - now) * params["Q"], time
        S, nu = H @ P @ H.T + R, value - H @ x
        # One component after the other, of noise made independent: what is free has a density.
        density, free = 0.0, []
        for k in range(2):
            row, rest, left = np.eye(2)[k], nu[k], S[k, k]
            if free:
                weights = np.linalg.solve(S[np.ix_(free, free)], S[free, k])
                row[free] -= weights
                rest, left = nu[k] - weights @ nu[free], left - weights @ S[free, k]
            if left > least:
                density -= (rest**2 / left + np.log(2 * np.pi * left)) / 2
                free = [*free, k]
        K = P @ H[free].T @ np.linalg.inv(S[np.ix_(free, free)]) if free else np.zeros((3, 0))
        kept = np.eye(3) - K @ H[free]
        x, P = x + K @ nu[free], kept @ P @ kept.T + K @ R[np.ix_(free, free)] @ K.T
        P = np.where(np.abs(P) < least / 1e3, 0, P)
        found.append((x, P, density))
    return [np.array(column) for column in zip(*found, strict=True)]


def check(name, sight, case):
    params, stream = world(sight, case)
    trace = ran(name)(params, stream)
    mean, cov, density = filtered(params, stream)
    np.testing.assert_allclose(trace.mean, mean, atol=1e-9)
    np.testing.assert_allclose(trace.cov, cov, atol=1e-9)
    np.testing.assert_allclose(trace.info.log_likelihood, density, atol=1e-8)
    assert (trace.info.status == ej.Status.USED).all()


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("sight", SEEN)
@pytest.mark.parametrize("name", FILTERS)
def test_it_is_left_out(name, sight, case):
    check(name, sight, case)


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("sight", SEEN)
@pytest.mark.parametrize("name", OTHERS)
def test_it_is_left_out_of_the_others(name, sight, case):
    check(name, sight, case)


def test_a_batch_is_its_runs():
    """Where rounding decided, a batch was another filter than its runs."""
    params, stream = world("oblique", "one exact component")
    twice = jax.tree.map(lambda x: np.stack([x, x]), params)
    values = stream._replace(value=np.stack([stream.value] * 2))
    batch = ej.run_batch(
        FILTERS["unscented"](), twice, values, prior=PRIOR, t0=0.0, params_per_run=True
    )
    alone = ran("unscented")(params, stream)
    np.testing.assert_allclose(batch.mean[1], alone.mean, atol=1e-12)
    np.testing.assert_allclose(batch.info.log_likelihood[1], alone.info.log_likelihood, atol=1e-9)


def test_the_likelihood_keeps_its_slope_in_r():
    """At r = 0 the variance after the first measurement is 0; its derivative in r is 1."""
    params, stream = world("one axis each", "no noise")

    def variance(r):
        return ran("kalman")({**params, "R": r * np.eye(2)}, stream).cov[0, 0, 0]

    np.testing.assert_allclose(jax.grad(variance)(0.0), 1.0, rtol=1e-9)
