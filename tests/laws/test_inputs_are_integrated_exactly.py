"""A known input is integrated exactly over any interval, in any filter."""

from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import ewif_jax as ej
from ewif_jax.models import constant_velocity, from_continuous, position_sensor, random_walk
from laws.cases import close

CHANGES = np.array([0.4, 1.3, 1.8])
ACCELERATION = np.array([[1.0, -2.0], [-3.0, 0.5], [4.0, 1.0]])
U = ej.inputs(CHANGES, ACCELERATION)
SENSOR = position_sensor(0.2, dims=2)
MODEL = constant_velocity(sensors=SENSOR, q=0.1, dims=2, u=lambda p: p["u"])
FREE = constant_velocity(sensors=SENSOR, q=0.1, dims=2)
TIMES = np.array([0.2, 1.0, 1.5, 2.5, 3.0])
VALUES = np.random.default_rng(3).normal(size=(5, 2))
STREAM = ej.stream(TIMES, VALUES)
PRIOR = ej.Gaussian(np.array([0.3, -0.1, 0.5, 0.2]), np.diag([1.0, 2.0, 0.5, 0.5]))
GIVEN = {"prior": PRIOR, "t0": 0.0}


def held(xp, dt):
    """What an acceleration held over dt does (4, 2)."""
    eye = xp.eye(2)
    return xp.concatenate([dt**2 / 2 * eye, dt * eye])


def moved(dt):
    return np.eye(4) + dt * np.eye(4, k=2)


def effect(t0: float, t1: float, values: np.ndarray = ACCELERATION) -> np.ndarray:
    """What the input does from t0 to t1 >= t0, piece by piece."""
    cuts = [t0, *(t for t in CHANGES if t0 < t < t1), t1]
    total = np.zeros(4)
    for a, b in pairwise(cuts):
        u = values[max(int(np.sum(a >= CHANGES)) - 1, 0)]
        total = moved(b - a) @ total + held(np, b - a) @ u
    return total


def by_hand(values: np.ndarray = ACCELERATION) -> tuple[np.ndarray, np.ndarray, float]:
    """The textbook filter: means, covariances, log likelihood."""
    x, P, now, total, H = PRIOR.mean, PRIOR.cov, 0.0, 0.0, np.eye(2, 4)
    means, covs = [], []
    for time, value in zip(TIMES, VALUES, strict=True):
        dt = time - now
        Q = 0.1 * np.kron(np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]]), np.eye(2))
        x = moved(dt) @ x + effect(now, time, values)
        P, now = moved(dt) @ P @ moved(dt).T + Q, time
        S = H @ P @ H.T + 0.2 * np.eye(2)
        nu, K = value - H @ x, P @ H.T @ np.linalg.inv(S)
        total -= 0.5 * (nu @ np.linalg.solve(S, nu) + np.log(np.linalg.det(2 * np.pi * S)))
        x, P = x + K @ nu, P - K @ H @ P
        means.append(x)
        covs.append(P)
    return np.stack(means), np.stack(covs), total


def test_it_is_the_textbook_filter_and_so_is_its_gradient():
    @jax.jit
    def total(values):
        trace = ej.run(ej.kalman(MODEL), {"u": ej.inputs(CHANGES, values)}, STREAM, **GIVEN)
        return jnp.sum(trace.info.log_likelihood), trace

    (likelihood, trace), slope = jax.value_and_grad(total, has_aux=True)(jnp.asarray(ACCELERATION))
    means, covs, expected = by_hand()
    close(trace.mean, means)
    close(trace.cov, covs)
    np.testing.assert_allclose(likelihood, expected, rtol=1e-12)
    for k in np.ndindex(3, 2):
        step = np.zeros((3, 2))
        step[k] = 1e-5
        low, high = (by_hand(ACCELERATION + s * step)[2] for s in (-1, 1))
        np.testing.assert_allclose(slope[k], (high - low) / 2e-5, rtol=1e-6)


def test_the_slope_in_the_times_is_the_finite_difference():
    def total(times):
        c = MODEL.linear.b({"u": ej.inputs(times, ACCELERATION)}, 0.0, 3.0)
        return jnp.sum(c * jnp.arange(1.0, 5.0))

    slope = jax.jit(jax.grad(total))(jnp.asarray(CHANGES))
    for k, d in enumerate(1e-6 * np.eye(3)):
        numeric = (total(CHANGES + d) - total(CHANGES - d)) / 2e-6
        np.testing.assert_allclose(slope[k], numeric, rtol=1e-6, atol=1e-8)


def test_it_is_one_run_with_an_arrival_at_every_change():
    """Where nothing is measured, and the input is constant in between."""

    def constant(params, t0, t1):
        now = jnp.maximum(jnp.sum(t0 >= CHANGES) - 1, 0)
        return held(jnp, t1 - t0) @ jnp.asarray(ACCELERATION)[now]

    cut = constant_velocity(sensors=SENSOR, q=0.1, dims=2, b=constant)
    stamps = np.concatenate([TIMES, CHANGES])
    order = np.argsort(stamps)
    values = np.concatenate([VALUES, np.full((3, 2), np.nan)])
    rows = ej.stream(stamps[order], values[order])
    # By the clock masked rows move the filter too.
    expected = ej.run(ej.kalman(cut), None, rows, times=stamps[order], clock="arrival", **GIVEN)
    found = ej.run(ej.kalman(MODEL), {"u": U}, STREAM, **GIVEN)
    close(found.mean, expected.mean[order < 5])
    close(found.cov, expected.cov[order < 5])


ORDER = np.array([0, 1, 3, 2, 4])
LATE = ej.stream(TIMES[ORDER], VALUES[ORDER])
METHODS = {
    "kalman": ej.kalman,
    "ewif": lambda model: ej.ewif(model, 2.0),
    "al1": lambda model: ej.al1(model, 4),
    "replay": lambda model: ej.replay(ej.kalman(model), 4),
    "information": ej.information,
    "unscented": ej.unscented,
    "asd": lambda model: ej.asd(model, 4),
}
SLOW = ("replay", "information", "unscented", "asd")
"""Checked with --all."""


@pytest.mark.parametrize(
    "build",
    [
        pytest.param(b, id=n, marks=pytest.mark.slow if n in SLOW else ())
        for n, b in METHODS.items()
    ],
)
def test_it_is_the_filter_without_an_input_of_data_less_what_the_input_does(build):
    """Late data too: the way back takes the input off again."""
    far = np.stack([effect(0.0, t) for t in TIMES])
    less = ej.stream(TIMES[ORDER], (VALUES - far[:, :2])[ORDER])
    found = ej.run(build(MODEL), {"u": U}, LATE, **GIVEN)
    expected = ej.run(build(FREE), None, less, **GIVEN)
    newest = np.maximum.accumulate(ORDER)
    close(found.mean, expected.mean + far[newest])
    close(found.cov, expected.cov)


def test_there_and_back_is_where_it_was():
    x = jnp.asarray(PRIOR.mean)
    for t0, t1 in ((0.1, 2.9), (1.3, 1.8), (1.4, 1.5)):
        there = MODEL.transition({"u": U}, x, t0, t1)
        close(there, moved(t1 - t0) @ PRIOR.mean + effect(t0, t1))
        close(MODEL.transition({"u": U}, there, t1, t0), x)


def test_smoothers_and_batches_take_it_too():
    both = np.stack([ACCELERATION, -ACCELERATION])
    params = {"u": ej.inputs(CHANGES, ACCELERATION)}
    each = {"u": jax.tree.map(lambda x: jnp.stack([x, x]), params["u"])}
    each["u"] = jax.tree.unflatten(
        jax.tree.structure(each["u"]), [jax.tree.leaves(each["u"])[0], jnp.asarray(both)]
    )
    rows = jax.tree.map(lambda x: jnp.stack([x, x]), STREAM)
    many = ej.run_batch(ej.kalman(MODEL), each, rows, params_per_run=True, **GIVEN)
    close(many.mean[0], by_hand()[0])
    close(many.mean[1], by_hand(-ACCELERATION)[0])
    far = np.stack([effect(0.0, t) for t in TIMES])
    smooth = ej.rts(MODEL, params, STREAM, **GIVEN)
    free = ej.rts(FREE, None, ej.stream(TIMES, VALUES - far[:, :2]), **GIVEN)
    close(smooth.mean, free.mean + far)
    fitted = ej.batch_wls(MODEL, params, STREAM, TIMES[3:], weight=lambda p, a, b: 1.0)
    plain = ej.batch_wls(
        FREE, None, ej.stream(TIMES, VALUES - far[:, :2]), TIMES[3:], weight=lambda p, a, b: 1.0
    )
    close(fitted.mean, plain.mean + far[3:])


A, B = np.eye(4, k=2), np.eye(4, 2, k=-2)
SAME = {
    "random walk": (
        random_walk(sensors=position_sensor(1.0, 2), dims=2, u=U),
        lambda t0, t1: effect(t0, t1)[2:],
    ),
    "linear_model": (
        ej.linear_model(
            lambda p, t0, t1: jnp.eye(4) + (t1 - t0) * jnp.eye(4, k=2),
            np.eye(2, 4), np.eye(2), B=lambda p, t0, t1: held(jnp, t1 - t0), u=U,
        ),
        effect,
    ),
    "from_continuous": (from_continuous(A, B, 1.0, SENSOR, B=B, u=U), effect),
    "from_continuous, of params": (
        from_continuous(lambda p: jnp.asarray(A), B, 1.0, SENSOR, B=lambda p: jnp.asarray(B), u=U),
        effect,
    ),
    "beside another input": (
        constant_velocity(sensors=SENSOR, dims=2, u=U, b=lambda p, t0, t1: (t1 - t0) * jnp.ones(4)),
        lambda t0, t1: effect(t0, t1) + (t1 - t0),
    ),
    "most": (
        constant_velocity(sensors=SENSOR, dims=2, u=ej.inputs(CHANGES, ACCELERATION, most=3)),
        effect,
    ),
}  # fmt: skip


@pytest.mark.parametrize(("model", "expected"), SAME.values(), ids=SAME)
def test_every_model_integrates_it(model, expected):
    for t0, t1 in ((0.0, 3.0), (0.5, 1.0), (1.3, 1.8), (2.0, 2.0), (-1.0, 0.4)):
        close(model.linear.b(None, jnp.asarray(t0), jnp.asarray(t1)), expected(t0, t1))


def test_jerk_drives_constant_acceleration():
    model = ej.models.constant_acceleration(sensors=position_sensor(1.0), u=ej.inputs([0.0], [2.0]))
    c = model.linear.b(None, jnp.asarray(1.0), jnp.asarray(4.0))
    np.testing.assert_allclose(c, [2 * 27 / 6, 2 * 9 / 2, 2 * 3], rtol=1e-12)


def test_the_rate_at_a_change_is_the_new_input():
    model = ej.models.jittered(random_walk(sensors=position_sensor(0.0, 2), dims=2, u=U), 1.0)
    for time, u in ((0.9, ACCELERATION[0]), (1.3, ACCELERATION[1]), (9.0, ACCELERATION[2])):
        R = model.jitter(None, jnp.zeros(2), jnp.int32(0), jnp.asarray(time))
        close(R, np.outer(u, u))


def test_what_is_not_known_is_nan():
    strict = ej.inputs(CHANGES, ACCELERATION, outside="nan")
    few = ej.inputs(CHANGES, ACCELERATION, most=2)

    @jax.jit
    def pushed(given, t0, t1):
        return MODEL.linear.b({"u": given}, t0, t1)

    for given, inside, outside in (
        (strict, [(0.4, 1.8), (0.0, 0.0)], [(0.3, 1.0), (1.0, 1.9)]),
        (few, [(0.5, 1.5), (1.5, 9.0), (-1.0, 1.0), (0.4, 1.8)], [(0.5, 1.9)]),
    ):
        for t0, t1 in inside:
            close(pushed(given, t0, t1), effect(t0, t1))
        for t0, t1 in outside:
            assert np.isnan(pushed(given, t0, t1)).all()


STEP, KICK = np.array([[1.0, 0.5], [-0.1, 0.9]]), np.array([[0.0, 1.0], [2.0, -1.0]])


def discrete(u, F=STEP, B=KICK):
    return ej.linear_model(F, np.eye(1, 2), np.eye(1), 0.1 * np.eye(2), B=B, u=u, dt=0.5)


@pytest.mark.parametrize("read", [False, True], ids=["arrays", "of params"])
def test_a_discrete_model_takes_it_step_by_step(read):
    steps = ej.inputs([0.0, 1.0, 2.0], ACCELERATION)
    matrices = [lambda p: p["F"], lambda p: p["B"]] if read else [STEP, KICK]
    model, params = discrete(steps, *matrices), {"F": STEP, "B": KICK}
    for t0, t1 in ((0.0, 3.0), (0.5, 1.5), (1.0, 1.0), (1.5, 2.0)):
        expected = np.zeros(2)
        for t in np.arange(t0, t1, 0.5):
            expected = STEP @ expected + KICK @ ACCELERATION[int(min(t, 2.0))]
        close(model.linear.b(params, jnp.asarray(t0), jnp.asarray(t1)), expected)


def test_a_change_between_two_steps_is_refused_or_nan():
    between = ej.inputs([0.0, 0.7], ACCELERATION[:2])
    rows = ej.stream([0.5, 1.0], [0.0, 1.0])
    prior = ej.Gaussian(np.zeros(2), np.eye(2))
    with pytest.raises(ValueError, match=r"u.times: expected whole steps of dt = 0.5 s"):
        ej.run(ej.kalman(discrete(between)), None, rows, prior=prior, t0=0.0)
    model = discrete(lambda p: p["u"])
    c = jax.jit(model.linear.b)({"u": between}, 0.5, 1.0)
    assert np.isnan(c).all()


def test_single_precision():
    prior = jax.tree.map(lambda x: x.astype(np.float32), PRIOR)
    rows = ej.stream(TIMES, VALUES.astype(np.float32))
    found = ej.run(ej.kalman(MODEL), {"u": U}, rows, prior=prior, t0=0.0)
    assert found.mean.dtype == np.float32
    close(found.mean, by_hand()[0], 1e-5)


REFUSED = {
    "times that stand still": (
        lambda: ej.inputs([0.0, 1.0, 1.0], np.zeros(3)),
        "times: expected times that increase, got 1.0 after 1.0",
    ),
    "no times": (lambda: ej.inputs([], []), "times: expected at least one, got none"),
    "other lengths": (
        lambda: ej.inputs([0.0, 1.0], np.zeros(3)),
        "values: expected shape (2, k), got shape (3, 1)",
    ),
    "no number": (
        lambda: ej.inputs([0.0, 1.0], [1.0, np.nan]),
        "values: expected finite numbers, got nan at index (1, 0)",
    ),
    "an unknown outside": (
        lambda: ej.inputs([0.0], [1.0], outside="zero"),
        "outside: expected 'hold' or 'nan', got 'zero'",
    ),
    "no pieces": (
        lambda: ej.inputs([0.0], [1.0], most=0),
        "most: expected a whole number >= 1, got 0",
    ),
    "u is an array": (
        lambda: constant_velocity(sensors=SENSOR, dims=2, u=np.ones(2)),
        "u: expected inputs(times, values), or a function of params that gives them, got a ndarray",
    ),
    "u of params is a number": (
        lambda: ej.run(ej.kalman(MODEL), {"u": 1.0}, STREAM, **GIVEN),
        "u: expected inputs(times, values), or a function of params that gives them, got a float",
    ),
    "as many numbers as it has not": (
        lambda: ej.run(ej.kalman(MODEL), {"u": ej.inputs([0.0], [1.0])}, STREAM, **GIVEN),
        "u.values: expected shape (K, 2), got shape (1, 1)",
    ),
    "B without u": (
        lambda: ej.linear_model(STEP, np.eye(1, 2), np.eye(1), B=KICK),
        "u: expected the input that B is for, inputs(...), got None",
    ),
    "u without B": (
        lambda: ej.linear_model(STEP, np.eye(1, 2), np.eye(1), u=U),
        "B: expected what the input u does to the state, got None",
    ),
    "a B of another size": (
        lambda: discrete(U, B=np.ones((3, 2))),
        "B: expected shape (2, k), got shape (3, 2)",
    ),
    "a B of one step beside an F of intervals": (
        lambda: discrete(U, F=lambda p, t0, t1: jnp.eye(2)),
        "Q: expected a function of (params, t0, t1), as F is one: a constant speaks of one step, "
        "whose length such an F does not say, got a constant",
    ),
}


@pytest.mark.parametrize(("build", "said"), REFUSED.values(), ids=REFUSED)
def test_what_is_refused(build, said):
    with pytest.raises(ValueError, match="expected") as error:
        build()
    assert str(error.value) == said
