"""`monte_carlo` averages what it says, and neither chunks nor devices show."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import ewif_jax as ej

MODEL = ej.models.random_walk(sensors=ej.models.position_sensor(1.0), q=0.5)
PRIOR = ej.Gaussian(np.zeros(1), np.eye(1))
STEPS = 20


def simulate(key):
    noise = jax.random.normal(key, (2, STEPS))
    start = jax.random.normal(jax.random.fold_in(key, 1))
    truth = (start + jnp.cumsum(jnp.sqrt(0.5) * noise[0]))[:, None]
    time = jnp.arange(1.0, STEPS + 1)
    stream = ej.Measurement(
        time, truth + noise[1][:, None], jnp.zeros(STEPS, jnp.int32), jnp.ones((STEPS, 1), bool)
    )
    return ej.Simulation(stream, truth, None)


SCENARIO = ej.Scenario(simulate, PRIOR, 0.0)
KEY = jax.random.key(2)
METRICS = {"squared_error": ej.scores.squared_error, "nees": ej.scores.normalised_error}


def test_it_is_the_average_of_single_runs():
    found = ej.monte_carlo(
        ej.kalman(MODEL), None, SCENARIO, runs=6, key=KEY, chunk=3, metrics=METRICS
    )
    errors = []
    for i in range(6):
        simulation = simulate(jax.random.fold_in(KEY, i))
        trace = ej.run(ej.kalman(MODEL), None, simulation.measurements, prior=PRIOR, t0=0.0)
        errors.append(np.mean((np.asarray(trace.mean) - np.asarray(simulation.truth)) ** 2))
    np.testing.assert_allclose(found.per_run["squared_error"], errors, rtol=1e-10)
    rmse, error = found.root("squared_error")
    np.testing.assert_allclose(rmse, np.sqrt(np.mean(errors)), rtol=1e-12)
    wanted = np.std(errors, ddof=1) / np.sqrt(6) / (2 * rmse)
    np.testing.assert_allclose(error, wanted, rtol=1e-10)


def test_chunks_do_not_show_and_progress_is_told():
    seen = []
    results = [
        ej.monte_carlo(
            ej.kalman(MODEL), None, SCENARIO, runs=10, key=KEY, chunk=chunk,
            progress=lambda done, of: seen.append((done, of)),
        )
        for chunk in (10, 5)
    ]  # fmt: skip
    a, b = results
    np.testing.assert_allclose(a.per_run["squared_error"], b.per_run["squared_error"], rtol=1e-12)
    np.testing.assert_allclose(a.per_step["squared_error"], b.per_step["squared_error"], rtol=1e-12)
    assert seen == [(10, 10), (5, 10), (10, 10)]


def test_an_honest_filter_has_unit_nees():
    found = ej.monte_carlo(ej.kalman(MODEL), None, SCENARIO, runs=400, key=KEY, metrics=METRICS)
    mean, error = found.mean("nees")
    assert abs(mean - 1.0) < 4 * error


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"runs": 1}, "runs: expected a whole number >= 2"),
        ({"key": None}, "key: expected a PRNG key"),
        ({"chunk": 0}, "chunk: expected a whole number >= 1"),
    ],
)
def test_misuse_is_refused(change, message):
    arguments = {"runs": 4, "key": KEY} | change
    with pytest.raises(ValueError, match=message):
        ej.monte_carlo(ej.kalman(MODEL), None, SCENARIO, **arguments)
