"""The fast layout changes no number: `run_batch` is `vmap(run)`, with shared and per-run inputs."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import ewif_jax as ej

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
