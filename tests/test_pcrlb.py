"""The posterior Cramer-Rao bounds against the dense Fisher information of whole trajectories."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from laws.cases import close
from oracles import fisher

import ewif_jax as ej
from ewif_jax import Measurement
from ewif_jax.analysis.pcrlb import pcrlb, pcrlb_equivalent, pcrlb_late
from ewif_jax.models import bearing_sensor, constant_velocity, coordinated_turn, predict_state

PLACES = np.array([[-200.0, 0.0], [200.0, 0.0]])
R = 0.05**2
BANK = [bearing_sensor(R, place) for place in PLACES]
TURN = coordinated_turn(sensors=BANK, q=4.0, q_turn=0.01)
STRAIGHT = constant_velocity(sensors=BANK, q=4.0, dims=2)
COV = {4: np.diag([40.0, 50.0, 6.0, 7.0]) ** 2, 5: np.diag([40.0, 50.0, 6.0, 7.0, 0.2]) ** 2}
TIME = np.array([0.0, 0.7, 1.5, 1.5, 2.6, 4.0, 4.3])
SENSOR = np.array([0, 1, 1, 0, 0, 1, 0])
ARRIVAL = np.array([0.5, 1.5, 2.0, 2.0, 5.2, 4.0, 5.2])


def truth(n, number=0):
    """A true path, not one of the model's: a slow turn with a swing."""

    def path(t):
        angle = 0.3 + 0.11 * t + 0.2 * number
        swing = 3.0 * np.cos(2.0 * t + number)
        here = [-150 + 300 * np.sin(angle), 90 + 300 * np.cos(angle) + swing]
        speed = [33 * np.cos(angle), -33 * np.sin(angle)]
        return np.array([*here, *speed, -0.11][:n])

    return path


def turned(x, t0, t1):
    """The turn in NumPy; without a rate it is straight."""
    dt, w = t1 - t0, x[4] if len(x) == 5 else 0.0
    a = w * dt
    S, C = (np.sin(a) / w, (1 - np.cos(a)) / w) if w else (dt, 0.0)
    east = x[0] + S * x[2] - C * x[3]
    north = x[1] + C * x[2] + S * x[3]
    moved = [np.cos(a) * x[2] - np.sin(a) * x[3], np.sin(a) * x[2] + np.cos(a) * x[3]]
    return np.array([east, north, *moved, w][: len(x)])


def F(x, t0, t1):
    step = 1e-5 * np.maximum(np.abs(x), 1.0)
    columns = [
        (turned(x + d * e, t0, t1) - turned(x - d * e, t0, t1)) / (2 * d)
        for d, e in zip(step, np.eye(len(x)), strict=True)
    ]
    return np.array(columns).T


def Q(n):
    def noise(t0, t1):
        h = t1 - t0
        full = np.zeros((5, 5))
        full[:4, :4] = 4.0 * np.kron([[h**3 / 3, h**2 / 2], [h**2 / 2, h]], np.eye(2))
        full[4, 4] = 0.01 * h
        return full[:n, :n]

    return noise


def H(x, sensor):
    """(68)."""
    east, north = x[:2] - PLACES[sensor]
    return np.array([[-north, east, *np.zeros(len(x) - 2)]]) / (east**2 + north**2)


def world(n):
    return {"t0": 0.0, "prior_cov": COV[n], "F": F, "Q": Q(n), "H": H, "R": R}


def stream(time=TIME, sensor=SENSOR, seen=None):
    mask = np.ones((len(time), 1), bool) if seen is None else seen[:, None]
    return Measurement(time, np.zeros((len(time), 1)), sensor.astype(np.int32), mask)


def along(n, times, number=0):
    return np.array([truth(n, number)(t) for t in times])


@pytest.fixture(scope="module")
def in_order():
    """The bound along one path with the turn, and averaged over three."""
    paths = np.stack([along(5, TIME, k) for k in range(3)])
    starts = paths[:, 0]
    find = jax.jit(lambda x, s: pcrlb(TURN, None, stream(), x, start=s, prior_cov=COV[5], t0=0.0))
    return find(paths[0], starts[0]), find(paths, starts)


@pytest.mark.parametrize("count", [1, 3])
def test_the_recursion_is_the_last_block_of_the_joint_information(in_order, count):
    paths = [truth(5, k) for k in range(count)]
    for k, t in enumerate(TIME):
        used = slice(0, k + 1)
        exact = fisher.bound(paths, times=TIME[used], sensors=SENSOR[used], report=t, **world(5))
        scale = np.sqrt(np.outer(np.diag(exact), np.diag(exact)))
        np.testing.assert_allclose(in_order[count // 2][k] / scale, exact / scale, atol=2e-8)


def test_each_measurement_counts_at_its_own_time_once_it_has_arrived():
    times = np.maximum.accumulate(ARRIVAL)
    found = jax.jit(
        lambda x: pcrlb_late(
            TURN, None, stream(), x, start=truth(5)(0.0), prior_cov=COV[5], t0=0.0, times=times
        )
    )(along(5, TIME))
    order = np.random.default_rng(1).permutation(TIME.size)
    mixed = pcrlb_late(
        STRAIGHT, None, stream(TIME[order], SENSOR[order]), along(4, TIME[order]),
        start=truth(4)(0.0), prior_cov=COV[4], t0=0.0, times=np.full(TIME.size, 5.2),
    )  # fmt: skip
    for k, t in enumerate(times):
        some, few = slice(0, k + 1), order[: k + 1]
        exact = fisher.bound(
            [truth(5)], times=TIME[some], sensors=SENSOR[some], report=t, **world(5)
        )
        np.testing.assert_allclose(found[k], exact, rtol=1e-6, atol=1e-7 * exact.max())
        exact = fisher.bound(
            [truth(4)], times=TIME[few], sensors=SENSOR[few], report=5.2, **world(4)
        )
        np.testing.assert_allclose(mixed[k], exact, rtol=1e-6, atol=1e-7 * exact.max())


def test_the_published_version_and_how_far_it_is_off():
    times = np.maximum.accumulate(ARRIVAL)
    given = {"start": truth(4)(0.0), "prior_cov": COV[4], "t0": 0.0, "times": times}
    found = pcrlb_equivalent(STRAIGHT, None, stream(), along(4, times), **given)
    expected = fisher.equivalent(
        truth(4), times=TIME, sensors=SENSOR, reports=times, back=turned, **world(4)
    )
    close(found, np.array(expected), 1e-7)
    right = pcrlb_late(STRAIGHT, None, stream(), along(4, TIME), **given)
    position = np.trace(np.asarray(found - right)[:, :2, :2], axis1=1, axis2=2)
    assert position[-1] > 0


def test_nothing_late_is_the_plain_bound():
    given = {"start": truth(4)(0.0), "prior_cov": COV[4], "t0": 0.0}
    plain = pcrlb(STRAIGHT, None, stream(), along(4, TIME), **given)
    for other in (pcrlb_late, pcrlb_equivalent):
        close(other(STRAIGHT, None, stream(), along(4, TIME), **given, times=TIME), plain, 1e-9)


def test_it_is_the_covariance_of_the_kalman_filter_for_a_linear_model():
    """Also where Q is zero and the start is known exactly in part, and for masked components."""
    rng = np.random.default_rng(3)
    F = np.array([[1.0, 0.4], [0.0, 1.0]])
    model = ej.linear_model(F, np.eye(2), np.diag([0.5, 2.0]), np.diag([0.0, 0.3]))
    mask = rng.random((6, 2)) < 0.6
    measured = Measurement(
        np.arange(1.0, 7.0), rng.normal(size=(6, 2)), np.zeros(6, np.int32), mask
    )
    cov = np.diag([0.0, 3.0])
    prior = ej.Gaussian(np.zeros(2), cov)
    exact = ej.run(ej.kalman(model), None, measured, prior=prior, t0=0.0).cov
    given = {"start": np.zeros(2), "prior_cov": cov, "t0": 0.0}
    close(pcrlb(model, None, measured, np.zeros((6, 2)), **given), exact, 1e-9)
    late = {**given, "times": measured.time}
    close(pcrlb_late(model, None, measured, np.zeros((6, 2)), **late), exact, 1e-9)


def test_it_is_the_covariance_of_the_extended_filter_linearised_at_the_truth():
    """Which it is where the target moves without noise, and the filter starts and measures without
    error."""
    start = truth(5)(0.0)
    path = np.stack([turned(start, 0.0, t) for t in TIME])
    seen = path[:, :2] - PLACES[SENSOR]
    exact = stream()._replace(value=np.arctan2(seen[:, 1], seen[:, 0])[:, None])
    prior = ej.Gaussian(start, COV[5])
    trace = ej.run(ej.extended(TURN), None, exact, prior=prior, t0=0.0)
    np.testing.assert_allclose(trace.mean, path, rtol=1e-9)
    found = pcrlb(TURN, None, exact, path, start=start, prior_cov=COV[5], t0=0.0)
    close(found, trace.cov, 1e-9)


def test_an_estimate_that_is_reported_for_the_past_has_no_bound_here():
    given = {"start": truth(4)(0.0), "prior_cov": COV[4], "t0": 0.0}
    found = pcrlb_late(STRAIGHT, None, stream(), along(4, TIME), **given, times=TIME - 0.1)
    assert np.isnan(found).all()


def test_the_bound_in_float32_and_its_derivative():
    small = along(4, TIME).astype(np.float32)
    given = {"start": small[0], "prior_cov": COV[4].astype(np.float32), "t0": 0.0}
    found = pcrlb(STRAIGHT, None, stream(), small, **given)
    assert found.dtype == np.float32
    exact = pcrlb(STRAIGHT, None, stream(), along(4, TIME), **given)
    np.testing.assert_allclose(found, exact, rtol=1e-3, atol=1e-4 * np.abs(exact).max())


def test_its_derivative_is_the_difference_quotient():
    model = constant_velocity(sensors=BANK, q=lambda q: q, dims=2)
    given = {"start": truth(4)(0.0), "prior_cov": COV[4], "t0": 0.0}

    @jax.jit
    @jax.value_and_grad
    def last(q):
        return pcrlb(model, q, stream(), along(4, TIME), **given)[-1, 0, 0]

    quotient = (last(4.0 + 1e-4)[0] - last(4.0 - 1e-4)[0]) / 2e-4
    np.testing.assert_allclose(last(4.0)[1], quotient, rtol=1e-5)
    assert np.isfinite(last(0.0)[1])


@pytest.mark.parametrize("bound", [pcrlb, pcrlb_late, pcrlb_equivalent])
def test_a_second_call_compiles_nothing(bound):
    traced = []

    def observe(params, x, sensor, t):
        traced.append(x)
        return STRAIGHT.observe(params, x, sensor, t)

    given = {"start": truth(4)(0.0), "prior_cov": COV[4], "t0": 0.0}
    given |= {} if bound is pcrlb else {"times": TIME}
    model = STRAIGHT._replace(observe=observe)
    first = bound(model, None, stream(), along(4, TIME), **given)
    once = len(traced)
    second = bound(model, None, stream(), along(4, TIME), **given)
    np.testing.assert_array_equal(first, second)
    assert len(traced) == once > 0


def test_no_filter_beats_it():
    """The mean square error of the extended filter, bearings of a target drawn from the model."""
    runs, rng = 400, np.random.default_rng(5)
    time = np.arange(1.0, 13.0)
    states = [truth(4)(0.0) + rng.normal(size=(runs, 4)) @ np.sqrt(COV[4] / 25)]
    step = jax.vmap(
        lambda x: predict_state(STRAIGHT, None, x, jnp.asarray(0.0), jnp.asarray(1.0))[0]
    )
    factor = np.linalg.cholesky(Q(4)(0.0, 1.0))
    for _ in time:
        states.append(np.asarray(step(states[-1])) + rng.normal(size=(runs, 4)) @ factor.T)
    path = np.stack(states[1:], 1)
    sensor = (np.arange(12) % 2).astype(np.int32)
    seen = path[..., :2] - PLACES[sensor]
    value = np.arctan2(seen[..., 1], seen[..., 0]) + 0.05 * rng.normal(size=(runs, 12))
    measured = Measurement(time, value[..., None], sensor, np.ones((12, 1), bool))
    prior = ej.Gaussian(truth(4)(0.0), COV[4] / 25)
    trace = ej.run_batch(ej.extended(STRAIGHT), None, measured, prior=prior, t0=0.0)
    error = np.sum((np.asarray(trace.mean) - path)[..., :2] ** 2, -1)
    one = stream(time, sensor)
    bound = pcrlb(STRAIGHT, None, one, path, start=states[0], prior_cov=COV[4] / 25, t0=0.0)
    floor = np.asarray(bound)[:, 0, 0] + np.asarray(bound)[:, 1, 1]
    shortfall = (floor - error.mean(0)) / (error.std(0) / np.sqrt(runs))
    assert shortfall.max() < 3
    assert np.all(error.mean(0) < 1.5 * floor)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"prior_cov": -np.eye(4)}, "prior_cov: expected a positive semidefinite matrix"),
        ({"start": np.zeros(3)}, "start: expected shape"),
        ({"truth": np.zeros((3, 4))}, "truth: expected shape"),
        (
            {"measurements": stream(TIME[::-1])},
            "measurements.time: expected times that do not decrease",
        ),
    ],
)
def test_what_cannot_be_is_refused(change, message):
    given = {
        "measurements": stream(), "truth": along(4, TIME), "start": np.zeros(4),
        "prior_cov": COV[4], "t0": 0.0, **change,
    }  # fmt: skip
    with pytest.raises(ValueError, match=message):
        pcrlb(STRAIGHT, None, **given)
