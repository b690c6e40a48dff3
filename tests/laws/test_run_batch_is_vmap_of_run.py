"""The fast layout changes no number: `run_batch` is `vmap(run)`, with shared and per-run inputs."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import ewif_jax as ej
from ewif_jax import layout
from ewif_jax import scores as scores_of
from ewif_jax.scores import scored

RUNS, STEPS = 5, 12
SENSORS = [ej.models.position_sensor(r, dims=2) for r in (0.5, 2.0)]
MODEL = ej.models.constant_velocity(sensors=SENSORS, q=lambda p: p["q"], dims=2)
PRIOR = ej.Gaussian(np.zeros(4), np.eye(4))
ESTIMATORS = {
    "kalman": ej.kalman(MODEL),
    "ewif": ej.ewif(MODEL, lambda p: p["tau"]),
    "selective_al1": ej.selective(ej.al1(MODEL, lag=6), lambda p: p["cutoff"]),
}


def streams(shared: bool) -> ej.Measurement:
    rng = np.random.default_rng(3)
    time = np.arange(STEPS) + rng.uniform(-1.5, 1.5, (RUNS, STEPS)) + 2.0
    sensor = rng.integers(0, 2, (RUNS, STEPS))
    mask = rng.uniform(size=(RUNS, STEPS, 2)) > 0.2
    value = rng.normal(size=(RUNS, STEPS, 2))
    if shared:
        time, sensor, mask = time[0], sensor[0], mask[0]
    return ej.Measurement(time, value, sensor, mask)


@pytest.mark.parametrize("shared", [True, False], ids=["shared", "per_run"])
@pytest.mark.parametrize("name", ESTIMATORS)
def test_run_batch_is_vmap_of_run(name, shared):
    estimator, batch = ESTIMATORS[name], streams(shared)
    params = {
        "q": np.linspace(0.1, 2.0, RUNS),
        "tau": np.linspace(0.5, 4.0, RUNS),
        "cutoff": np.linspace(0.0, 3.0, RUNS),
    }
    if shared:
        params = {key: x[2] for key, x in params.items()}
    got = ej.run_batch(estimator, params, batch, prior=PRIOR, t0=0.0, params_per_run=not shared)
    one = 0 if not shared else None
    axes = (one, ej.Measurement(one, 0, one, one))
    wanted = jax.vmap(lambda p, m: ej.run(estimator, p, m, prior=PRIOR, t0=0.0), in_axes=axes)(
        params, batch
    )
    for field in ("time", "mean", "cov", "info"):
        jax.tree.map(
            lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-10),
            getattr(got, field),
            getattr(wanted, field),
        )
    assert jnp.all(jnp.isfinite(got.mean))


@pytest.mark.parametrize("steps", [7, 20], ids=["one_block", "blocks"])
def test_gradients_go_through_groups_of_runs(steps, monkeypatch):
    """In reverse mode, with the results of all groups in one array."""
    rng = np.random.default_rng(6)
    values, time = rng.normal(size=(32, steps, 2)), np.cumsum(rng.uniform(0.1, 1.0, steps))
    batch = ej.Measurement(time, values, np.zeros(steps, int), np.ones((steps, 2), bool))

    def loss(q):
        trace = ej.run_batch(ej.kalman(MODEL), {"q": q}, batch, prior=PRIOR, t0=0.0)
        return jnp.sum(trace.mean**2) + jnp.sum(trace.cov)

    together = jax.value_and_grad(loss)(0.7)
    monkeypatch.setattr(layout, "_SECOND_CACHE", 16 * 8 * (1 + 4 + 10))
    np.testing.assert_allclose(jax.value_and_grad(loss)(0.7), together, rtol=1e-10)


@pytest.mark.parametrize("cache", [1, 16 * 8 * (1 + 4 + 10)], ids=["one_by_one", "in_groups"])
def test_neither_groups_of_runs_nor_blocks_of_steps_show(cache, monkeypatch):
    monkeypatch.setattr(layout, "_SECOND_CACHE", cache)
    monkeypatch.setattr(jax, "default_backend", lambda: "cpu")
    runs, steps = 32, 96
    rng = np.random.default_rng(5)
    time = np.cumsum(rng.uniform(0.1, 1.0, (runs, steps)), 1)
    batch = ej.Measurement(
        time, rng.normal(size=(runs, steps, 2)), np.zeros(steps, int), np.ones((steps, 2), bool)
    )
    q = np.linspace(0.1, 2.0, runs)
    assert layout.group_size(runs, 8 * (4 + 10), 8, 8 * 16) == (1 if cache == 1 else 16)
    assert layout._block(steps) == 32
    estimator = ej.kalman(MODEL)
    got = ej.run_batch(estimator, {"q": q}, batch, prior=PRIOR, t0=0.0, params_per_run=True)
    for k in (0, 17, 31):
        one = jax.tree.map(lambda x, k=k: x[k] if x.ndim > 1 and len(x) == runs else x, batch)
        wanted = ej.run(estimator, {"q": q[k]}, one, prior=PRIOR, t0=0.0)
        np.testing.assert_allclose(got.mean[k], wanted.mean, rtol=1e-10, atol=1e-12)
        np.testing.assert_allclose(got.cov[k], wanted.cov, rtol=1e-10, atol=1e-12)
        np.testing.assert_allclose(got.final_state.mean[k], wanted.final_state.mean, atol=1e-12)
    scores = {"score": scores_of.squared_innovation}  # without a truth, which is then of width 0
    found = scored(
        estimator, {"q": q}, batch, scores=scores, prior=PRIOR, t0=0.0, params_per_run=True
    )["score"]
    np.testing.assert_allclose(found, np.sum(got.info.innovation**2, -1), rtol=1e-10)


def test_raw_and_typed_keys_are_split_over_the_runs():
    estimator = ej.ensemble(MODEL, 8)
    batch = ej.Measurement(
        np.arange(3.0), np.zeros((2, 3, 2)), np.zeros(3, int), np.ones((3, 2)) > 0
    )
    raw, typed = jax.random.PRNGKey(4), jax.random.key(4)
    a, b, c = (
        ej.run_batch(estimator, {"q": 1.0}, batch, prior=PRIOR, t0=0.0, key=key).mean
        for key in (raw, typed, jax.random.split(typed, 2))
    )
    np.testing.assert_array_equal(a, b)
    np.testing.assert_array_equal(b, c)
    assert np.any(np.asarray(b[0]) != np.asarray(b[1]))
