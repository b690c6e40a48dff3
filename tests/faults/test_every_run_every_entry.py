# ruff: noqa: E501
"""What is refused of one run is refused of every run, by every entry, by the name of the argument."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import ewif_jax as ej
from ewif_jax import Gaussian, Measurement, every_run
from ewif_jax.models import constant_velocity, position_sensor

R, T = 4, 5
MODEL = constant_velocity(sensors=position_sensor(0.5), q=0.2)
TUNED = constant_velocity(sensors=position_sensor(lambda p: p["r"]), q=lambda p: p["q"])
KALMAN, ENSEMBLE = ej.kalman(MODEL), ej.ensemble(MODEL, 5)
PRIOR = Gaussian(np.zeros(2), np.eye(2))
MEAN, COV = np.zeros((R, 2)), np.tile(np.eye(2), (R, 1, 1))
TIME = np.arange(1.0, T + 1)
BATCH = Measurement(TIME, np.ones((R, T, 1)), np.zeros(T, int), np.ones((T, 1), bool))
ONE = BATCH._replace(value=BATCH.value[0])
EWIF = ej.ewif(MODEL, lambda p: p["tau"])


def batch(estimator=KALMAN, params=None, prior=PRIOR, t0=0.0, options=None, **fields):
    return ej.run_batch(
        estimator, params, BATCH._replace(**fields), prior=prior, t0=t0, **(options or {})
    )


def changed(x, value, run=2):
    x = np.array(x, float)
    x[run] = value
    return x


def keys(count):
    return jax.random.split(jax.random.key(0), count)


RUNS = {"params_per_run": True}
ALL_R = {"r": np.ones(R), "q": 1.0}
CONTEXT = {"observe": lambda step, seen: seen, "context": np.ones((T - 1, 2))}
REFUSED = {
    "runs of time": (lambda: batch(time=np.tile(TIME, (3, 1))), "measurements.time: expected 4 runs"),
    "runs of mask": (lambda: batch(mask=np.ones((3, T, 1), bool)), "measurements.mask: expected 4 runs"),
    "runs of sensor": (lambda: batch(sensor=np.zeros((3, T), int)), "measurements.sensor: expected 4 runs"),
    "no runs": (lambda: batch(value=np.ones((0, T, 1))), "measurements: expected at least one run"),
    "one stream": (lambda: batch(value=np.ones((T, 1))), "measurements.value: expected shape (R, T, m)"),
    "arrivals of time": (lambda: batch(time=np.ones((R, 3))), "measurements.time: expected 5 arrivals"),
    "runs of prior.mean": (lambda: batch(prior=PRIOR._replace(mean=MEAN[:3])), "prior.mean: expected 4 runs"),
    "runs of prior.cov": (lambda: batch(prior=PRIOR._replace(cov=COV[:3])), "prior.cov: expected 4 runs"),
    "sizes of the prior": (lambda: batch(prior=Gaussian(MEAN, np.tile(np.eye(3), (R, 1, 1)))), "prior.cov: expected matrices (2, 2)"),
    "a tuple for the prior": (lambda: batch(prior=(MEAN, COV)), "prior: expected a Gaussian"),
    "not PSD": (lambda: batch(prior=PRIOR._replace(cov=changed(COV, [[1, 2], [2, 1]]))), "prior.cov: expected a positive semidefinite"),
    "not symmetric": (lambda: batch(prior=PRIOR._replace(cov=changed(COV, [[1, 0.5], [0, 1]]))), "prior.cov: expected a symmetric"),
    "NaN in a mean": (lambda: batch(prior=PRIOR._replace(mean=changed(MEAN, np.nan))), "prior.mean: expected finite"),
    "singular": (lambda: batch(ej.ewif(MODEL, 2.0), prior=PRIOR._replace(cov=changed(COV, 0.0))), "prior.cov: expected a positive definite"),
    "runs of times": (lambda: batch(options={"times": np.tile(TIME, (3, 1))}), "times: expected 4 runs"),
    "length of times": (lambda: batch(options={"times": np.ones((R, 3))}), "times: expected shape (R, 5)"),
    "times that go back": (lambda: batch(options={"times": changed(np.tile(TIME, (R, 1)), [1, 2, 5, 4, 6])}), "times: expected report times that do not decrease, got 4.0 after 5.0 in run 2"),
    "runs of t0": (lambda: batch(t0=np.zeros(R)), "t0: expected shape ()"),
    "runs of params": (lambda: batch(EWIF, {"tau": np.ones(3)}, options=RUNS), "params['tau']: expected 4 runs"),
    "a number per run": (lambda: batch(EWIF, {"tau": 1.0}, options=RUNS), "params['tau']: expected 4 runs"),
    "not a prefix": (lambda: batch(EWIF, {"tau": 1.0}, options={"params_per_run": {"q": True}}), "params_per_run: expected True, False"),
    "not marked": (lambda: batch(ej.kalman(TUNED), ALL_R), "params['r']: expected a value that all runs share"),
    "not marked, of two": (lambda: batch(ej.kalman(TUNED), {"r": np.ones(R), "q": np.ones(R)}, options={"params_per_run": {"r": True, "q": False}}), "params['q']: expected a value that all runs share"),
    "a bad one, deeper": (lambda: batch(ej.ewif(MODEL, lambda p: p["a"]["tau"]), {"a": {"tau": changed(np.ones(R), -1)}}, options=RUNS), "tau: expected a positive"),
    "keys": (lambda: batch(ENSEMBLE, options={"key": keys(3)}), "key: expected a PRNG key"),
    "an int for a key": (lambda: batch(ENSEMBLE, options={"key": 0}), "key: expected a PRNG key"),
    "context": (lambda: batch(options=CONTEXT), "context: expected 5 arrivals"),
    "a key of run": (lambda: ej.run(ENSEMBLE, None, ONE, prior=PRIOR, t0=0.0, key=0), "key: expected a PRNG key"),
    "keys of run": (lambda: ej.run(ENSEMBLE, None, ONE, prior=PRIOR, t0=0.0, key=keys(2)), "key: expected a PRNG key"),
    "a model for run": (lambda: ej.run(MODEL, None, ONE, prior=PRIOR, t0=0.0), "estimator: expected an Estimator"),
    "a model for run_batch": (lambda: batch(MODEL), "estimator: expected an Estimator"),
    "an estimator for rts": (lambda: ej.rts(KALMAN, None, ONE, prior=PRIOR, t0=0.0), "model: expected a Model"),
    "an estimator for batch_wls": (lambda: ej.batch_wls(KALMAN, None, ONE, TIME, weight=lambda p, a, b: 1.0), "model: expected a Model"),
    "an estimator for run_parallel": (lambda: ej.run_parallel(KALMAN, None, ONE, tau=1.0, prior=None, t0=0.0), "model: expected a Model"),
    "no t0": (lambda: ej.run(KALMAN, None, ONE, prior=PRIOR, t0=None), "t0: expected the time of the prior"),
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED)
def test_refused_by_name(name):
    attempt, message = REFUSED[name]
    with pytest.raises(ValueError, match="^" + re.escape(message)):
        attempt()


def test_the_runs_that_are_tried_have_the_lowest_number_or_eigenvalue_anywhere():
    def tried(x, run, value):
        return every_run.lowest(changed(x, value, run), True)

    assert 3 in tried(np.ones((R, 2, 3)), 3, -1)
    assert 1 in tried(np.ones((R, 2)), 1, np.nan)
    assert 2 in tried(np.ones((R, 2)), 2, np.inf)
    assert 2 in tried(COV, 2, [[1, 2], [2, 1]])


def test_no_entry_clamps_a_sensor():
    table = jnp.array([[[1.0, 0.0]], [[0.0, 1.0]]])
    model = ej.linear_model(
        lambda p, a, b: jnp.eye(2), lambda p, sensor, t: table[sensor], np.eye(1)
    )
    stream = ONE._replace(sensor=np.array([0, 1, 5, 1, 0]))
    options = {"prior": PRIOR, "t0": 0.0}
    entries = (
        lambda: ej.run(ej.kalman(model), None, stream, **options),
        lambda: ej.rts(model, None, stream, **options),
        lambda: ej.two_sided_ewif(model, None, stream, tau=1.0),
        lambda: ej.batch_wls(model, None, stream, TIME, weight=lambda p, a, b: 1.0),
        lambda: ej.run_parallel(model, None, stream, tau=1.0, **options),
    )
    for entry in entries:
        with pytest.raises(ValueError, match=r"sensor: expected an index inside the tables"):
            entry()


def test_a_key_for_each_run_is_run_with_that_key_whatever_came_before():
    each = keys(R)
    for key in (each, jax.random.key(1), each):
        got = batch(ENSEMBLE, options={"key": key})
    want = ej.run(ENSEMBLE, None, ONE, prior=PRIOR, t0=0.0, key=each[3])
    np.testing.assert_allclose(got.mean[3], want.mean, rtol=1e-9)
