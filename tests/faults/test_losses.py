"""Losses score rows that the data fix, and their gradients are slopes wherever they stand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

import ewif_jax as ej

T = 20
RNG = np.random.default_rng(5)
TIME = np.arange(1.0, T + 1)
WALK = np.cumsum(RNG.normal(size=T)) * 3
VALUE = WALK + 0.3 * RNG.normal(size=T)
TRUTH = WALK[:, None]
MODEL = ej.models.random_walk(
    sensors=[ej.models.position_sensor(lambda p: p["r"]), ej.models.position_sensor(0.5)],
    q=lambda p: p["q"],
)
PARAMS = {"q": jnp.asarray(9.0), "r": jnp.asarray(0.1), "tau": jnp.asarray(1.0)}
PRIOR = ej.Gaussian(np.zeros(1), np.eye(1))
SENSOR = np.arange(T) % 2
EWIF = ej.ewif(MODEL, lambda p: p["tau"])
KALMAN = ej.kalman(MODEL)


def all_losses(estimator, stream, truth, **setting):
    return {
        "rmse": ej.rmse_loss(estimator, stream, truth, **setting),
        "likelihood": ej.likelihood_loss(estimator, stream, **setting),
        "prediction": ej.prediction_loss(estimator, stream, **setting),
        "robust": ej.prediction_loss(estimator, stream, robust=True, **setting),
        "nees": ej.nees_loss(estimator, stream, truth, **setting),
        "nis": ej.nis_loss(estimator, stream, **setting),
    }


def stacked(estimator, stream, truth, **setting):
    every = all_losses(estimator, stream, truth, **setting)
    return lambda params: jnp.stack([loss(params) for loss in every.values()])


def late_rows():
    """Every third row two to five seconds late: `drop_late` uses none of those."""
    late = (np.arange(T) % 3 == 2) & (np.arange(T) > 5)
    return ej.stream(TIME - np.where(late, 4.5, 0), VALUE, SENSOR), late


def by_hand(late):
    """Scores of a NumPy Kalman filter (q = 9, r by sensor), the late rows charged by NumPy."""
    mean, cov, time = 0.0, 1.0, 0.0
    noise = np.where(SENSOR == 0, 0.1, 0.5)
    square, nll = np.zeros(T), np.zeros(T)
    for k in range(T):
        own = VALUE[SENSOR[k] == SENSOR]
        if late[k]:
            square[k] = (VALUE[k] - own.mean()) ** 2
            nll[k] = -stats.norm.logpdf(VALUE[k], own.mean(), 10 * own.std())
            continue
        cov, time = cov + 9.0 * (TIME[k] - time), TIME[k]
        square[k] = (VALUE[k] - mean) ** 2
        nll[k] = -stats.norm.logpdf(VALUE[k], mean, np.sqrt(cov + noise[k]))
        gain = cov / (cov + noise[k])
        mean, cov = mean + gain * (VALUE[k] - mean), (1 - gain) * cov
    return square, nll


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_rows_that_are_not_used_cost_what_the_mean_and_spread_predict(dtype):
    stream, late = late_rows()
    stream = stream._replace(value=stream.value.astype(dtype), time=stream.time.astype(dtype))
    square, nll = by_hand(late)
    dropping, setting = ej.drop_late(KALMAN), {"prior": PRIOR, "t0": 0.0}
    every = all_losses(dropping, stream, TRUTH, **setting)
    tight = {"rtol": 1e-9 if dtype == np.float64 else 1e-4}
    np.testing.assert_allclose(every["likelihood"](PARAMS), nll.mean(), **tight)
    np.testing.assert_allclose(every["prediction"](PARAMS), np.sqrt(square.mean()), **tight)
    np.testing.assert_allclose(every["robust"](PARAMS), np.sqrt(square).mean(), **tight)
    total = ej.log_likelihood(dropping, PARAMS, stream, **setting)
    np.testing.assert_allclose(total, -nll.sum(), **tight)
    old = ej.likelihood_loss(dropping, stream, unused="leave out", **setting)
    np.testing.assert_allclose(old(PARAMS), nll[~late].mean(), **tight)


def test_a_batch_shares_the_mean_of_a_sensor_and_traced_data_cost_the_same():
    stream, _ = late_rows()
    batch = stream._replace(value=np.stack([VALUE, VALUE + 5])[..., None])
    loss = lambda z: ej.prediction_loss(ej.drop_late(KALMAN), z, prior=PRIOR, t0=0.0)(PARAMS)  # noqa: E731
    np.testing.assert_allclose(jax.jit(loss)(batch), loss(batch), rtol=1e-12)


def test_a_loss_first_called_inside_of_a_trace_can_be_called_again():
    loss = ej.prediction_loss(KALMAN, ej.stream(TIME, VALUE), prior=PRIOR, t0=0.0)
    jax.eval_shape(lambda: loss(PARAMS))
    np.testing.assert_allclose(jax.jit(loss)(PARAMS), loss(PARAMS), rtol=1e-12)


def test_losing_a_row_is_never_rewarded():
    """Over a gap of 200 tau the next value is predicted well; over one of 2000 tau the information
    is gone, and the row costs more instead of leaving the average."""
    value, truth = np.concatenate([VALUE, VALUE[::-1]]), np.concatenate([TRUTH, TRUTH[::-1]])
    params = PARAMS | {"tau": jnp.asarray(0.5)}

    @jax.jit
    def both(time):
        stream = ej.stream(time, jnp.asarray(value))
        prediction = ej.prediction_loss(EWIF, stream, prior=None, t0=0.0)
        return prediction(params), ej.rmse_loss(EWIF, stream, truth, prior=None, t0=0.0)(params)

    short, long = (both(np.concatenate([TIME, gap + TIME])) for gap in (100.0, 1000.0))
    charge = (VALUE[-1] - value.mean()) ** 2
    weight = np.exp((TIME - TIME[-1]) / 0.5)
    predicted = (VALUE[-1] - weight @ VALUE / weight.sum()) ** 2
    wanted = (charge - predicted) / (2 * T - 1)
    np.testing.assert_allclose(long[0] ** 2 - short[0] ** 2, wanted, rtol=1e-6)
    np.testing.assert_allclose(long[1], short[1], rtol=1e-3)


def test_a_latency_beyond_the_lag_does_not_raise_the_likelihood():
    def likelihood(latency):
        time = TIME - np.where(SENSOR == 1, latency, 0.0)
        stream = ej.stream(np.maximum(time, 0.05), VALUE, SENSOR)
        return float(ej.log_likelihood(ej.al1(MODEL, 4), PARAMS, stream, prior=PRIOR, t0=0.0))

    assert likelihood(12.0) < likelihood(0.0)


@pytest.mark.parametrize(
    ("components", "rows"), [(2, T - 2), (1, T - 2)], ids=["nothing missing", "one missing"]
)
def test_rows_before_data_can_determine_a_state_do_not_count(components, rows):
    """Constant velocity from nothing: two components, by count, whatever tau is."""
    model = ej.models.constant_velocity(sensors=ej.models.position_sensor(1.0))
    value = VALUE.copy()
    if components == 1:
        value[1], rows = np.nan, T - 3
    stream = ej.stream(TIME, value)
    loss = ej.prediction_loss(ej.ewif(model, 1e-5), stream, prior=None, t0=0.0)
    seen = np.isfinite(value)
    charge = (value - value[seen].mean()) ** 2
    np.testing.assert_allclose(loss(None) ** 2, charge[seen][2:].sum() / rows, rtol=1e-9)


HARD = {
    "error exactly 0": (np.zeros(T), np.zeros((T, 1)), {}, PRIOR),
    "q = 0 and an exact prior": (VALUE, TRUTH, {"q": 0.0}, PRIOR._replace(cov=np.zeros((1, 1)))),
    "r tiny": (VALUE, TRUTH, {"r": 1e-12}, PRIOR),
    "everything masked": (np.full(T, np.nan), TRUTH, {}, PRIOR),
    "identical times": (VALUE, TRUTH, {"time": 1.0}, PRIOR),
    "truth unknown": (VALUE, np.full((T, 1), np.nan), {}, PRIOR),
}


@pytest.fixture(scope="module")
def both_modes():
    """Values, forward and reverse derivatives of all losses of the Kalman filter: one program."""

    @jax.jit
    def program(params, stream, truth, prior):
        loss = stacked(KALMAN, stream, truth, prior=prior, t0=0.0)
        return loss(params), jax.jacfwd(loss)(params), jax.jacrev(loss)(params)

    return program


@pytest.mark.parametrize("name", HARD)
def test_derivatives_are_finite_and_equal_at_hard_points(both_modes, name):
    value, truth, change, prior = HARD[name]
    time = np.full(T, change["time"]) if "time" in change else TIME
    params = PARAMS | {k: jnp.asarray(x) for k, x in change.items() if k != "time"}
    stream = ej.stream(time, value, SENSOR)
    values, forward, reverse = both_modes(params, stream, truth, prior)
    assert np.isfinite(values).all(), values
    for key in ("q", "r"):
        assert np.isfinite(forward[key]).all()
        np.testing.assert_allclose(forward[key], reverse[key], rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize(
    ("values", "truth"), [([0.0, 1e20, 0.0], 0.0), ([0.0, 1.0, 0.0], 1e20)], ids=["value", "truth"]
)
def test_infinite_scores_are_not_left_out(values, truth):
    stream = ej.stream(np.arange(1.0, 4), np.asarray(values, np.float32))
    known = np.full((3, 1), truth, np.float32)
    every = all_losses(KALMAN, stream, known, prior=PRIOR, t0=0.0)
    params = {k: jnp.float32(x) for k, x in PARAMS.items()}
    names = ("rmse",) if truth else ("likelihood", "prediction")
    assert all(np.isposinf(every[name](params)) for name in names)


@pytest.mark.parametrize(
    ("metric", "said"),
    [(ej.nees, "nees"), (lambda step: 0.0, "fails with"), (lambda s, t, m: s.mean, "shape")],
    ids=["a function of arrays", "one argument", "a vector"],
)
def test_what_is_no_score_is_named(metric, said):
    stream = ej.stream(TIME, VALUE)
    with pytest.raises(ValueError, match=rf"metrics\['mine'\]: expected a score.*{said}"):
        ej.scores.scored(
            KALMAN, PARAMS, stream, TRUTH, scores={"mine": metric}, prior=PRIOR, t0=0.0
        )
    assert not hasattr(ej.scores, "nees")


def test_tune_refuses_a_start_outside_of_the_domain_and_returns_the_best():
    loss = ej.rmse_loss(EWIF, ej.stream(TIME, VALUE), TRUTH, prior=None, t0=0.0)
    with pytest.raises(ValueError, match="tau: expected a positive number"):
        ej.tune(loss, {"tau": -5.0, "r": 0.1}, steps=3)
    edge = ej.tune(
        lambda p: jnp.where(p["x"] < 2, (p["x"] - 3) ** 2, jnp.nan), {"x": 1.0}, steps=40
    )
    assert 1.9 < edge.params["x"] < 2
    np.testing.assert_allclose(edge.loss, (edge.params["x"] - 3) ** 2, rtol=1e-6)
    assert "not finite" in edge.reason


@pytest.mark.parametrize("bad", [(2.0, 1.0), (0.0, np.inf), (1.0, 1.0)])
def test_bounds_that_are_none_are_refused(bad):
    with pytest.raises(ValueError, match=r"low|high"):
        ej.transforms.bounded(*bad)


def test_a_bounded_parameter_stays_inside():
    box = ej.transforms.bounded(0.5, 2.0)
    assert box == ej.transforms.bounded(0.5, 2.0)
    np.testing.assert_allclose(box.constrain(box.free(jnp.asarray(1.7))), 1.7, rtol=1e-6)
    found = ej.tune(lambda p: (p["x"] - 3) ** 2, {"x": 1.0}, steps=200, transforms=box)
    assert 1.8 < found.params["x"] <= 2.0
