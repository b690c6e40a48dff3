"""Averages over runs: nothing is lost in rounding, nothing infinite is left out, keys are keys."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import ewif_jax as ej

STEPS, RUNS = 3, 24
MODEL = ej.models.random_walk(sensors=ej.models.position_sensor(0.5), q=0.2)
PRIOR = ej.Gaussian(np.zeros(1, np.float32), np.eye(1, dtype=np.float32))


def simulate(key):
    value = jax.random.normal(key, (STEPS, 1), jnp.float32)
    stream = ej.Measurement(
        jnp.arange(1, STEPS + 1, dtype=jnp.float32),
        value,
        jnp.zeros(STEPS, jnp.int32),
        jnp.ones((STEPS, 1), bool),
    )
    return ej.Simulation(stream, value)


def far(step, truth, mask):
    return truth[0] + jnp.float32(3000)


def own(step, truth, mask):
    return truth[0]


def sometimes(step, truth, mask):
    return jnp.where(truth[0] > 1, jnp.inf, jnp.where(truth[0] < 0, jnp.nan, truth[0]))


SCENARIO = ej.Scenario(simulate, PRIOR, 0.0)
METRICS = {"own": own, "far": far, "sometimes": sometimes}


def measured(**change):
    setting = {"runs": RUNS, "key": jax.random.key(3), "metrics": METRICS, "chunk": 5} | change
    return ej.monte_carlo(ej.kalman(MODEL), None, SCENARIO, **setting)


@pytest.fixture(scope="module")
def found():
    return measured()


@pytest.fixture(scope="module")
def drawn():
    keys = jax.vmap(lambda i: jax.random.fold_in(jax.random.key(3), i))(jnp.arange(RUNS))
    return np.asarray(jax.vmap(simulate)(keys).truth[..., 0], np.float64)


@pytest.mark.parametrize(("name", "shift"), [("own", 0), ("far", 3000)])
def test_standard_errors_are_those_of_numpy_in_float64(found, drawn, name, shift):
    """E x^2 - (E x)^2 in float32 would lose them beside a mean of 3000 (off by a factor of 3)."""
    values = (drawn.astype(np.float32) + np.float32(shift)).astype(float)
    wanted = values.std(0, ddof=1) / np.sqrt(RUNS)
    np.testing.assert_allclose(found.per_step_se[name], wanted, rtol=1e-4)
    np.testing.assert_allclose(found.per_step[name], values.mean(0), rtol=1e-6, atol=1e-6)
    runs = values.mean(1)
    wanted = runs.mean(), runs.std(ddof=1) / np.sqrt(RUNS)
    np.testing.assert_allclose(found.mean(name), wanted, rtol=2e-3, atol=1e-6)


def test_infinite_values_count_and_missing_ones_are_counted(found, drawn):
    np.testing.assert_array_equal(found.missing["sometimes"], (drawn < 0).sum(1))
    np.testing.assert_array_equal(
        np.isinf(found.per_run["sometimes"]), (drawn > 1).any(1) & (drawn >= 0).any(1)
    )
    np.testing.assert_array_equal(np.isinf(found.per_step["sometimes"]), (drawn > 1).any(0))
    assert np.isinf(found.mean("sometimes")[0])


def test_one_key_for_each_run_does_what_the_call_says(drawn):
    keys = jax.vmap(lambda i: jax.random.fold_in(jax.random.key(3), i))(jnp.arange(RUNS))
    found = measured(key=keys)
    np.testing.assert_allclose(found.per_run["own"], drawn.mean(1), rtol=1e-5, atol=1e-6)


def test_filters_that_draw_take_a_key_for_each_run_in_the_first_call():
    stream = jax.vmap(simulate)(jax.random.split(jax.random.key(0), 3)).measurements
    keys = jax.random.split(jax.random.key(1), 3)
    both = [
        ej.run_batch(ej.ensemble(MODEL, 8), None, stream, prior=PRIOR, t0=0.0, key=key).mean
        for key in (keys, jax.random.key(1))
    ]
    np.testing.assert_array_equal(*both)


@pytest.mark.parametrize(
    "key", [7, np.int32(7), None, "seed", jnp.arange(3)], ids=["int", "int32", "None", "text", "i"]
)
def test_what_is_no_key_is_refused(key):
    with pytest.raises(ValueError, match="key: expected a PRNG key"):
        measured(key=key)


def test_keys_for_another_number_of_runs_are_refused():
    with pytest.raises(ValueError, match=r"key: expected .* got .*of shape \(3,\)"):
        measured(key=jax.random.split(jax.random.key(0), 3))


def test_another_precision_in_a_context_works(found):
    with jax.enable_x64(not jax.config.jax_enable_x64):
        again = measured()
    np.testing.assert_allclose(again.per_run["own"], found.per_run["own"], rtol=1e-5, atol=1e-6)
