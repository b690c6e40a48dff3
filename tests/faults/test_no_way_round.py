"""What turns out inside a trace to have no inverse: an R, an F. It ends in NaN or REJECTED, never
in an estimate that lacks a measurement without saying so."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import ewif_jax as ej

PRIOR = ej.Gaussian(np.zeros(2), np.eye(2))
TIME = np.arange(1.0, 6)
VALUE = np.array([0.3, 0.8, 1.1, 1.9, 2.2])[:, None]
SENSOR = np.array([0, 0, 1, 0, 0])
"""The third row has the sensor that is exact in some cases."""
STREAM = jax.tree.map(jnp.asarray, ej.Measurement(TIME, VALUE, SENSOR, np.ones((5, 1), bool)))
TAU = 0.002
"""So short that rows a second away count nothing in float64 (709 tau)."""


def line():
    """A line, seen by a sensor of variance r and one of variance s."""
    sensors = [ej.models.position_sensor(lambda p: p["r"]),
               ej.models.position_sensor(lambda p: p["s"])]  # fmt: skip
    return ej.models.constant_velocity(sensors=sensors, q=0.0)


LINE = line()


@jax.jit
def two_sided(params, prior):
    return ej.two_sided_ewif(LINE, params, STREAM, tau=lambda p: p["tau"], prior=prior, t0=0.0)


def least_squares(time, tau):
    """The prior and all rows, r = 1, weighted by exp(-|age| / tau), solved by NumPy."""
    rows, targets = [], []
    weight = np.exp(-abs(time) / 2 / tau)
    rows.extend(weight * np.array([[1.0, -time], [0.0, 1.0]]))
    targets.extend([0.0, 0.0])
    for stamp, value in zip(TIME, VALUE[:, 0], strict=True):
        weight = np.exp(-abs(time - stamp) / 2 / tau)
        rows.append(weight * np.array([1.0, stamp - time]))
        targets.append(weight * value)
    return np.linalg.lstsq(np.array(rows), np.array(targets))[0]


@pytest.mark.parametrize("exact", [False, True])
def test_two_sided_says_what_it_lacks(exact):
    params = {"r": 1.0, "s": 0.0 if exact else 1.0, "tau": 2.0}
    found = two_sided(params, PRIOR)
    if exact:
        assert np.isnan(found.mean).all()
        assert np.isnan(found.cov).all()
    else:
        right = [least_squares(time, 2.0) for time in TIME]
        np.testing.assert_allclose(found.mean, right, atol=1e-9)


def test_two_sided_lacks_only_what_counts():
    """Where the exact row has no weight left, nothing is lacking: the report at t0 is the prior."""
    wide = jax.jit(
        lambda params: ej.two_sided_ewif(
            LINE, params, STREAM, tau=lambda p: p["tau"], prior=PRIOR, t0=0.0,
            times=np.array([0.0, 3.0]),
        )
    )  # fmt: skip
    found = wide({"r": 1.0, "s": 0.0, "tau": TAU})
    np.testing.assert_allclose(found.mean[0], PRIOR.mean, atol=1e-12)
    np.testing.assert_allclose(found.cov[0], PRIOR.cov, atol=1e-12)
    assert np.isnan(found.mean[1]).all()


VECTOR = np.array([1.0, 2.0])


@pytest.mark.parametrize(
    ("name", "call"),
    {
        "tau": lambda: ej.two_sided_ewif(LINE, {"r": 1.0, "s": 1.0}, STREAM, tau=VECTOR),
        "tau of params": lambda: two_sided({"r": 1.0, "s": 1.0, "tau": VECTOR}, PRIOR),
        "tau of ewif": lambda: ej.ewif(LINE, VECTOR),
        "tau of run": lambda: ej.run(
            ej.ewif(LINE, lambda p: p["tau"]),
            {"r": 1.0, "s": 1.0, "tau": VECTOR},
            STREAM,
            prior=PRIOR,
            t0=0.0,
        ),
        "window": lambda: ej.limited_memory(LINE, VECTOR, 4),
        "tau of run_parallel": lambda: ej.run_parallel(
            LINE, {"r": 1.0, "s": 1.0}, STREAM, tau=VECTOR, prior=PRIOR, t0=0.0
        ),
    }.items(),
)
def test_a_setting_is_one_number(name, call):
    with pytest.raises(ValueError, match=rf"^{name.split()[0]}: expected one number"):
        call()


def test_a_setting_may_have_an_axis_of_one():
    found = ej.two_sided_ewif(
        LINE, {"r": 1.0, "s": 1.0}, STREAM, tau=np.array([2.0]), prior=PRIOR, t0=0.0
    )
    np.testing.assert_allclose(found.mean[2], least_squares(3.0, 2.0), atol=1e-9)


STEP = ej.linear_model(
    lambda p: p["F"],
    np.array([[[1.0, 0]], [[0, 1.0]]]),
    np.array([[[0.3]], [[0.5]]]),
    lambda p: 0.1 * np.eye(2),
)
MOTION = {
    "one mode ends": np.diag([1.0, 0.0]),
    "singular by rounding": np.array([[0.1, 0.2], [0.3, 0.6]]),
    "all ends": np.zeros((2, 2)),
    "regular": np.array([[0.9, 0.2], [0.0, 0.5]]),
}
FORMS = {"ewif": ej.ewif(STEP, 2.0), "information": ej.information(STEP)}
LATE = np.array([1.0, 3, 2, 4, 5])


@pytest.fixture(scope="module")
def runs():
    """Compiled once for all motions."""

    def of(form):
        def run(params, prior, time):
            return ej.run(form, params, STREAM._replace(time=time), prior=prior, t0=0.0)

        return jax.jit(run)

    return {name: of(form) for name, form in FORMS.items()}


def recursion(name, F, times, rows):
    """Kalman's recursion, of `ewif` with its fading and without process noise."""
    fading, noise = (np.exp(0.5), 0.0) if name == "ewif" else (1.0, 0.1)
    x, P, now, found = np.zeros(2), np.eye(2), 0.0, []
    for k in rows:
        for _ in range(round(times[k] - now)):
            x, P = F @ x, fading * F @ P @ F.T + noise * np.eye(2)
        now, H = times[k], np.eye(2)[SENSOR[k]]
        K = P @ H / (H @ P @ H + (0.3, 0.5)[SENSOR[k]])
        x, P = x + K * (VALUE[k, 0] - H @ x), P - np.outer(K, H @ P)
        found.append(x)
    return np.array(found)


@pytest.mark.parametrize("motion", MOTION)
@pytest.mark.parametrize("name", FORMS)
def test_a_traced_singular_motion(runs, name, motion):
    """With a prior the state moves as a covariance does. What is late needs the way back; so does
    what is known of a part of the state, which is all there is without a prior."""
    F, singular = MOTION[motion], motion != "regular"
    run = runs[name]
    trace = run({"F": F}, PRIOR, TIME)
    assert (trace.info.status == ej.Status.USED).all()
    np.testing.assert_allclose(trace.mean, recursion(name, F, TIME, range(5)), atol=1e-9)

    trace = run({"F": F}, PRIOR, LATE)
    refused = ej.Status.REJECTED if singular else ej.Status.LATE_USED
    assert trace.info.status[2] == (refused if name == "ewif" else ej.Status.TOO_LATE)
    if singular or name == "information":
        right = recursion(name, F, LATE, [0, 1, 3, 4])
        np.testing.assert_allclose(trace.mean[jnp.array([0, 1, 3, 4])], right, atol=1e-9)

    trace = run({"F": F}, None, TIME)
    if singular:
        assert np.isnan(trace.mean).all()
        assert (trace.info.status[1:] == ej.Status.REJECTED).all()
        assert (trace.info.log_likelihood[1:] == -np.inf).all()
    else:
        assert np.isfinite(trace.mean[2:]).all()
        assert (trace.info.status == ej.Status.USED).all()
