"""q, r, Q and R from `params` that are no variances: refused by name where they are known; where
they are not, every estimate is NaN, no variance is negative, and the derivative is 0."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import ewif_jax as ej

SENSOR = ej.models.position_sensor
STREAM = ej.stream(np.arange(1.0, 6.0), np.array([1.0, 2, 3, 4, 5]))
PRIOR = ej.Gaussian(np.zeros(2), np.eye(2))
H, STEP = np.array([[1.0, 0.0]]), np.array([[1.0, 1.0], [0.0, 1.0]])
KINEMATIC = ej.models.constant_velocity(sensors=SENSOR(lambda p: p["r"]), q=lambda p: p["q"])
MODELS = {
    "kinematic": KINEMATIC,
    "discrete": ej.linear_model(
        STEP, H, lambda p: p["r"] * jnp.eye(1), lambda p: p["q"] * jnp.eye(2)
    ),
    "functions": ej.linear_model(
        lambda p, t0, t1: jnp.asarray([[1.0, t1 - t0], [0.0, 1.0]]),
        H,
        lambda p, sensor, t: p["r"] * jnp.eye(1),
        lambda p, t0, t1: p["q"] * (t1 - t0) * jnp.eye(2),
    ),
    "continuous": ej.models.from_continuous(
        np.eye(2, k=1), np.eye(2)[:, 1:], lambda p: p["q"], SENSOR(lambda p: p["r"])
    ),
    "matrix r": ej.models.constant_velocity(
        sensors=SENSOR(lambda p: p["r"] * jnp.eye(1)), q=lambda p: p["q"]
    ),
}
BAD = [("q", -0.5), ("r", -0.5), ("r", -50.0), ("q", np.nan), ("q", np.inf), ("r", np.nan)]


@pytest.mark.parametrize("name", MODELS)
@pytest.mark.parametrize(("parameter", "value"), BAD)
def test_known_is_refused(name, parameter, value):
    params = {"q": 0.2, "r": 0.5, parameter: value}
    words = {"q": "(q|Q|intensity): expected", "r": "(r|R): expected"}[parameter]
    model, given = MODELS[name], {"prior": PRIOR, "t0": 0.0}
    for call in (
        lambda: ej.run(ej.kalman(model), params, STREAM, **given),
        lambda: ej.rts(model, params, STREAM, **given),
    ):
        with pytest.raises(ValueError, match=words):
            call()


def test_one_run_of_a_batch_is_enough():
    streams = STREAM._replace(value=np.ones((3, 5, 1)), mask=np.ones((3, 5, 1), bool))
    for bad in (-1.0, np.nan, np.inf):
        params = {"q": np.array([0.1, bad, 0.3]), "r": 0.5}
        with pytest.raises(ValueError, match="q: expected"):
            ej.run_batch(
                ej.kalman(KINEMATIC),
                params,
                streams,
                prior=PRIOR,
                t0=0.0,
                params_per_run={"q": True, "r": False},
            )


@pytest.mark.parametrize("name", ["kinematic", "functions", "discrete"])
def test_traced_is_nan_with_a_zero_derivative(name):
    model = MODELS[name]

    @jax.jit
    @jax.value_and_grad
    def total(params):
        Q = model.process_cov(params, jnp.asarray(0.0), jnp.asarray(2.0))
        R = model.measurement_cov(params, jnp.int32(0), jnp.asarray(0.0))
        return jnp.sum(Q) + jnp.sum(R)

    for bad in BAD:
        value, slope = total({"q": 0.2, "r": 0.5, bad[0]: bad[1]})
        assert np.isnan(value)
        assert slope[bad[0]] == 0
    value, slope = total({"q": 0.2, "r": 0.5})
    assert np.isfinite(value)
    assert min(slope.values()) > 0


def test_a_matrix_that_no_correlation_allows_is_nan():
    model = ej.linear_model(STEP, H, np.eye(1), lambda p: p)
    Q = jax.jit(lambda p: model.process_cov(p, jnp.asarray(0.0), jnp.asarray(1.0)))
    assert np.isnan(Q(np.array([[1.0, 2.0], [2.0, 1.0]]))).all()
    singular = np.array([[1.0, 2.0], [2.0, 4.0]])
    np.testing.assert_array_equal(Q(singular), singular)
    np.testing.assert_array_equal(Q(np.zeros((2, 2))), np.zeros((2, 2)))


def test_whole_numbers_are_numbers():
    found = [
        ej.run(ej.kalman(KINEMATIC), {"q": q, "r": r}, STREAM, prior=PRIOR, t0=0.0).mean[-1]
        for q, r in ((1.0, 2.0), (1, 2), (np.int32(1), np.int32(2)), (np.float32(1), 2))
    ]
    for other in found[1:]:
        np.testing.assert_allclose(other, found[0], rtol=1e-12)


def test_a_method_that_ignores_the_process_noise_needs_none():
    estimator = ej.ewif(KINEMATIC, lambda p: p["tau"])
    trace = ej.run(estimator, {"tau": 2.0, "r": 0.5}, STREAM, prior=PRIOR, t0=0.0)
    assert np.isfinite(trace.mean).all()


def test_a_name_that_params_has_not():
    with pytest.raises(ValueError, match=r"params: expected the name 'q', .*'r'"):
        ej.run(ej.kalman(KINEMATIC), {"r": 0.5}, STREAM, prior=PRIOR, t0=0.0)
    estimator = ej.ewif(ej.models.random_walk(sensors=SENSOR(1.0)), lambda p: p["tau"])
    with pytest.raises(ValueError, match="'tau'"):
        ej.run(estimator, {"Tau": 0.5}, STREAM, prior=None, t0=0.0)
    with pytest.raises(ValueError, match="got None"):
        ej.run(ej.kalman(KINEMATIC), None, STREAM, prior=PRIOR, t0=0.0)
