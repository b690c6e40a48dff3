"""A latency is taken out of the times, and all else follows: order, lateness, gradients."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import ewif_jax as ej

RNG = np.random.default_rng(5)
T = 12
TIMES = np.cumsum(RNG.uniform(0.4, 1.0, T))
SENSORS = np.arange(T) % 2
VALUES = np.cumsum(RNG.normal(size=T))[:, None]
LATENCY = np.array([0.0, 0.93])  # longer than most intervals: the order changes
PRIOR = ej.Gaussian(np.zeros(2), 4.0 * np.eye(2))
T0 = -2.0
SENSOR_PAIR = [ej.models.position_sensor(0.5), ej.models.position_sensor(lambda p: p["r"])]
MODEL = ej.models.constant_velocity(sensors=SENSOR_PAIR, q=lambda p: p["q"])
PARAMS = {"q": 0.3, "r": 0.2, "tau": 3.0}
STREAM = ej.stream(TIMES, VALUES, sensor=SENSORS)
SHIFTED = ej.stream(TIMES - LATENCY[SENSORS], VALUES, sensor=SENSORS)
ESTIMATORS = {
    "drop_late": ej.drop_late(ej.kalman(MODEL)),
    "ewif": ej.ewif(MODEL, lambda p: p["tau"]),
    "al1": ej.al1(MODEL, 4),
    "asd": ej.asd(MODEL, 4),
    "replay": ej.replay(ej.kalman(MODEL), 4),
}
NAMES = pytest.mark.parametrize("name", ESTIMATORS)


def of_params(params):
    return jnp.stack([0.0 * params["late"], params["late"]])


def same(a, b, tolerance=1e-12):
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        np.testing.assert_allclose(x, y, rtol=tolerance, atol=tolerance)


def test_the_setting_has_late_rows():
    late = TIMES - LATENCY[SENSORS]
    assert 2 < (late < np.maximum.accumulate(late)).sum() < T


@NAMES
def test_run_with_a_latency_is_run_at_the_shifted_times(name):
    estimator = ESTIMATORS[name]
    at = {"prior": PRIOR, "t0": T0}
    expected = ej.run(estimator, PARAMS, SHIFTED, **at)
    same(ej.run(estimator, PARAMS, STREAM, latency=LATENCY, **at), expected)
    params = {**PARAMS, "late": LATENCY[1]}
    same(ej.run(estimator, params, STREAM, latency=of_params, **at), expected)


def test_a_latency_may_be_traced():
    estimator, params = ESTIMATORS["al1"], {**PARAMS, "late": LATENCY[1]}

    def filtered(params):
        return ej.run(estimator, params, STREAM, prior=PRIOR, t0=T0, latency=of_params)

    same(jax.jit(filtered)(params), filtered(params))


@pytest.mark.parametrize("name", ["ewif", "al1"])
def test_each_run_of_a_batch_has_its_own_latency(name):
    estimator, lates = ESTIMATORS[name], np.array([0.0, 0.93, 0.2])
    batch = STREAM._replace(value=np.broadcast_to(np.asarray(STREAM.value), (3, T, 1)))
    params, flags = {**PARAMS, "late": lates}, {**dict.fromkeys(PARAMS, False), "late": True}
    got = ej.run_batch(
        estimator, params, batch, prior=PRIOR, t0=T0, latency=of_params, params_per_run=flags
    )
    for run, late in enumerate(lates):
        alone = {**PARAMS, "late": late}
        single = ej.run(estimator, alone, STREAM, prior=PRIOR, t0=T0, latency=of_params)
        same(jax.tree.map(lambda x, run=run: x[run], got), single, 1e-9)


@pytest.mark.parametrize("name", ["ewif", "asd", pytest.param("replay", marks=pytest.mark.slow)])
def test_slopes_are_finite_differences(name):
    """Away from the places where two measurements change their order."""
    estimator = ESTIMATORS[name]
    loss = ej.likelihood_loss(estimator, STREAM, prior=PRIOR, t0=T0, latency=of_params)

    def of(late):
        return loss({**PARAMS, "late": late})

    with jax.enable_x64():
        at, h = 0.61, 1e-5
        moved = np.sort(np.abs(np.subtract.outer(TIMES - at * SENSORS, TIMES - at * SENSORS)), None)
        assert moved[T] > 20 * h  # nothing changes its place
        difference = (of(at + h) - of(at - h)) / (2 * h)
        assert abs(difference) > 1e-3
        np.testing.assert_allclose(jax.grad(of)(at), difference, rtol=1e-6)
        if name == "ewif":  # what all others share forwards
            np.testing.assert_allclose(jax.jvp(of, (at,), (1.0,))[1], difference, rtol=1e-6)


def test_an_exact_method_has_a_kink_where_the_order_changes_and_drop_late_a_jump():
    gaps = TIMES[1:] - TIMES[:-1]
    at = gaps[SENSORS[1:] == 1].min()  # a row of sensor 1 passes the one of sensor 0 before it
    jumps = {}
    for name in ("asd", "drop_late"):
        loss = ej.likelihood_loss(ESTIMATORS[name], STREAM, prior=PRIOR, t0=T0, latency=of_params)
        low, high = (float(loss({**PARAMS, "late": at + h})) for h in (-1e-9, 1e-9))
        jumps[name] = abs(high - low)
    assert jumps["asd"] < 1e-7
    assert jumps["drop_late"] > 1e-3


@pytest.mark.slow
def test_tuning_recovers_a_latency():
    rng = np.random.default_rng(11)
    steps, late, runs = 40, 0.3, 20
    times = np.arange(1, steps + 1) * 0.5
    sensors = np.arange(steps) % 2
    true_times = times - late * sensors
    phase = rng.uniform(0, 6, (runs, 1))
    values = 3 * np.sin(0.8 * true_times + phase) + 0.1 * rng.normal(size=(runs, steps))
    batch = ej.Measurement(times, values[..., None], sensors, np.ones((runs, steps, 1), bool))
    pair = ej.models.position_sensor(0.01)
    model = ej.models.constant_velocity(sensors=[pair, pair], q=lambda p: p["q"])
    setting = {"prior": PRIOR, "t0": T0, "latency": of_params}
    loss = ej.likelihood_loss(ej.asd(model, 3), batch, **setting)
    tuned = ej.tune(loss, {"late": 0.0, "q": 1.0})
    errors = ej.standard_errors(ej.asd(model, 3), tuned.params, batch, **setting).errors
    assert errors["late"] < 0.02
    assert abs(tuned.params["late"] - late) < 4 * errors["late"] + 0.01


def test_a_row_beyond_the_lag_is_charged():
    """Moving rows out of the filter's reach does not make its predictions look better."""
    loss = ej.likelihood_loss(
        ej.al1(MODEL, 1), STREAM, prior=PRIOR, t0=T0, latency=lambda p: p["late"] * SENSOR_TWO
    )
    near, far = (float(loss({**PARAMS, "late": late})) for late in (0.0, 4.0))
    assert far > near


SENSOR_TWO = np.array([0.0, 1.0])
DISCRETE = ej.linear_model(np.eye(2), np.eye(1, 2), np.eye(1), np.eye(2), dt=0.5)


@pytest.mark.parametrize(
    ("latency", "message"),
    [
        (np.zeros((2, 2)), "latency: expected seconds"),
        ([0.1], "latency: expected one for each of 2 sensors"),
        ([0.0, np.nan], "latency"),
        ("late", "latency"),
        (lambda p: p["gone"], "gone"),
    ],
)
def test_what_is_no_latency_is_refused(latency, message):
    with pytest.raises(ValueError, match=message):
        ej.run(ej.kalman(MODEL), PARAMS, STREAM, prior=PRIOR, t0=T0, latency=latency)


def test_a_discrete_model_shifts_by_known_whole_steps():
    times = 0.5 * np.arange(1, 9)
    rows = ej.stream(times, VALUES[:8])
    at = {"prior": PRIOR, "t0": -2.0}
    shifted = ej.stream(times - 1.0, VALUES[:8])
    got = ej.run(ej.kalman(DISCRETE), {}, rows, latency=1.0, **at)
    same(got, ej.run(ej.kalman(DISCRETE), {}, shifted, **at))
    for latency in (0.3, lambda p: 0.5):
        with pytest.raises(ValueError, match=r"latency: expected known whole steps of dt = 0\.5 s"):
            ej.run(ej.kalman(DISCRETE), {}, rows, latency=latency, **at)


def test_corrected_gives_the_times_alone():
    got = ej.corrected(STREAM, LATENCY)
    np.testing.assert_array_equal(got.time, TIMES - LATENCY[SENSORS])
    assert got.value is STREAM.value
    assert np.asarray(ej.corrected(STREAM, 0.25).time).dtype == np.float64


def late_bank(latency):
    """The sensors of `MODEL`, of which the second knows its own latency."""

    def second(params, x, t):
        return x[:1]

    own = ej.models.sensor(second, lambda p: p["r"], latency=latency)
    return ej.models.constant_velocity(sensors=[SENSOR_PAIR[0], own], q=lambda p: p["q"])


def test_a_sensor_may_know_its_own_latency():
    """In every entry: `run`, `run_batch`, `step`, `step_batch`, smoothers."""
    params, at = {**PARAMS, "late": 0.93}, {"prior": PRIOR, "t0": T0}
    plain, known, tuned = (late_bank(x) for x in (0.0, 0.93, lambda p: p["late"]))
    expected = ej.run(ej.replay(ej.extended(plain), 4), params, SHIFTED, **at)
    for model in (known, tuned):
        estimator = ej.replay(ej.extended(model), 4)
        same(ej.run(estimator, params, STREAM, **at), expected)
        state = estimator.init(params, PRIOR, jnp.asarray(T0))
        many = jax.tree.map(lambda x: x[None], state)
        for row in ej.arrivals(STREAM):
            state, _ = ej.step(estimator, params, state, row)
            many, _ = ej.step_batch(
                estimator, params, many, jax.tree.map(lambda x: np.asarray(x)[None], row)
            )
        same(state, expected.final_state)
        same(jax.tree.map(lambda x: x[0], many), expected.final_state, 1e-9)
        same(ej.rts(model, params, STREAM, **at), ej.rts(plain, params, SHIFTED, **at))
    biased = ej.models.biased(ej.models.sensor(lambda p, x, t: x[:1], 1.0, latency=0.5), 0.1)
    assert biased.latency == 0.5
    with pytest.raises(ValueError, match="latency: expected None, since"):
        ej.run(ej.extended(known), params, STREAM, latency=0.1, **at)
