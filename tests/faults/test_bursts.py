"""Late measurements that arrive together: each meets a cloud resampled after the one before."""

import jax
import numpy as np
import pytest

import ewif_jax as ej

R, SENSOR = (0.3, 0.1), np.repeat([0, 1], 5)
TIMES = np.r_[np.arange(1.0, 6), 0.4, 1.3, 2.4, 3.5, 4.6]
MODEL = ej.models.constant_velocity(sensors=[ej.models.position_sensor(x) for x in R], q=0.3)
PRIOR = ej.Gaussian(np.zeros(2), np.eye(2))


def moved(dt):
    return np.array([[1, dt], [0, 1.0]])


def driven(dt):
    return 0.3 * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])


def data(seed):
    """Measurements drawn from the model."""
    rng = np.random.default_rng(seed)
    x, t, values = rng.standard_normal(2), 0.0, np.zeros(10)
    for k in np.argsort(TIMES):
        F, noise = moved(TIMES[k] - t), np.linalg.cholesky(driven(TIMES[k] - t))
        x, t = F @ x + noise @ rng.standard_normal(2), TIMES[k]
        values[k] = x[0] + np.sqrt(R[SENSOR[k]]) * rng.standard_normal()
    return values


def limit(values, order):
    """Kalman updates in this order; a late one by H F^-1, with the noise since then in R."""
    x, P, t = np.zeros(2), np.eye(2), 0.0
    for k in order:
        now = max(t, TIMES[k])
        F = moved(now - t)
        x, P, t = F @ x, F @ P @ F.T + driven(now - t), now
        h = moved(TIMES[k] - now)[0]
        S = h @ P @ h + R[SENSOR[k]] + h @ driven(now - TIMES[k]) @ h
        x, P = x + P @ h / S * (values[k] - h @ x), P - np.outer(P @ h, P @ h) / S
    return x, P


CASES = {
    "pf_retrodict": (ej.pf_retrodict(MODEL, 5000), np.arange(10)),
    # One late measurement between any two stored times: exact, as if all had come in order.
    "pf_extended": (ej.pf_extended(MODEL, 5000, 6), np.argsort(TIMES)),
}


@pytest.mark.parametrize("name", CASES)
def test_a_burst_leaves_a_cloud_that_is_near_its_limit(name):
    """With the weights of the burst multiplied on one cloud `pf_retrodict` is 0.6 sd off, with a
    tenth of the variance."""
    method, order = CASES[name]
    times = np.r_[TIMES[:5], np.full(5, 5.0)]

    def ended(key, values):
        stream = ej.stream(TIMES, values, SENSOR)
        trace = ej.run(
            method, None, stream, prior=PRIOR, t0=0.0, times=times, clock="arrival", key=key
        )
        return trace.mean[-1], trace.cov[-1]

    seeds = [data(seed) for seed in range(3)]
    ran = jax.jit(lambda values, keys: jax.lax.map(lambda key: ended(key, values), keys))
    keys = jax.random.split(jax.random.key(0), 5)
    off, shares = [], []
    for values in seeds:
        mean, cov = limit(values, order)
        means, covs = ran(values, keys)
        off.append((np.asarray(means) - mean) / np.sqrt(np.diag(cov)))
        shares.append(np.trace(np.mean(covs, 0)) / np.trace(cov))
    assert np.sqrt(np.mean(np.square(off))) < 0.15
    assert min(shares) > 0.85
    assert max(shares) < 1.15
