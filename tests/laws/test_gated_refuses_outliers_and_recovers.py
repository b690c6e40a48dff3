"""A gate refuses what is outside of it and nothing else (a loop in NumPy), whatever filter is
behind it; after a lock-out it opens, and it closes again; outliers alone open it as rarely as
stated."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from late_streams import problem, stream
from scipy.stats import chi2

import ewif_jax as ej
from ewif_jax import Status

GIVEN = problem(0, 2, m=2)
LAG, SIZE = 6, 40
USED, LATE, REJECTED = Status.USED, Status.LATE_USED, Status.REJECTED
TIMES = np.array([0.5, 1.0, 0.8, 1.5, 1.2, 2.0, 2.4, 2.2])
LATE_ROWS = np.maximum.accumulate(TIMES) > TIMES
BAD = np.array([3, 4])
"""One in sequence and one late; rows 2 and 7 are late too."""
CALM = stream(GIVEN, np.random.default_rng(2), TIMES)
CALM = CALM._replace(value=np.asarray(CALM.value) * 0.3)
WILD = CALM._replace(value=CALM.value + 1e6 * np.isin(np.arange(8), BAD)[:, None])
WITHOUT = CALM._replace(mask=CALM.mask & ~np.isin(np.arange(8), BAD)[:, None])
LEVEL = 1 - 1e-9
"""No row of CALM is outside."""
ESTIMATORS = {
    "kalman": lambda: ej.kalman(GIVEN.model),
    "square_root": lambda: ej.square_root(GIVEN.model),
    "information": lambda: ej.information(GIVEN.model),
    "ewif": lambda: ej.ewif(GIVEN.model, 2.0),
    "ewif_bank": lambda: ej.ewif_bank(GIVEN.model, (1.0, 3.0)),
    "extended": lambda: ej.extended(GIVEN.model),
    "unscented": lambda: ej.unscented(GIVEN.model),
    "ensemble": lambda: ej.ensemble(GIVEN.model, SIZE),
    "bootstrap": lambda: ej.bootstrap(GIVEN.model, 10 * SIZE),
    "pf_extended": lambda: ej.pf_extended(GIVEN.model, 10 * SIZE, LAG),
    "al1": lambda: ej.al1(GIVEN.model, LAG),
    "asd": lambda: ej.asd(GIVEN.model, LAG),
    "replay": lambda: ej.replay(ej.kalman(GIVEN.model), LAG),
}
ALWAYS = ("kalman", "ewif", "bootstrap", "asd", "replay")


def go(estimator, data, params=None, prior=GIVEN.prior, **options):
    options = {"key": jax.random.key(3), "t0": 0.0} | options
    return ej.run(estimator, params, data, prior=prior, **options)


def looped(data, level, patience):
    """Statuses, means, innovations and their covariances of a gated Kalman filter, and how many in
    a row were outside before each row; in NumPy."""
    t, x, P = 0.0, np.asarray(GIVEN.prior.mean), np.asarray(GIVEN.prior.cov)
    motion, rows, outside = GIVEN.oracle, [], 0
    for time, z, sensor, mask in zip(*map(np.asarray, data), strict=True):
        F, Q, b = (motion[name](t, time) for name in "FQb")
        t, x, P = time, F @ x + b, F @ P @ F.T + Q
        H, R = GIVEN.H[sensor][mask], GIVEN.R[sensor][np.ix_(mask, mask)]
        nu, S = z[mask] - H @ x, H @ P @ H.T + R
        is_out = nu @ np.linalg.solve(S, nu) > chi2.ppf(level, mask.sum())
        used = not is_out or outside >= patience
        before, outside = outside, min(outside + 1, patience) if is_out else 0
        if used:
            K = P @ H.T @ np.linalg.inv(S)
            x, P = x + K @ nu, P - K @ S @ K.T
        rows.append((used, x, nu, S, before))
    return rows


@pytest.fixture(scope="module")
def shifted():
    """40 rows in sequence of which some are partial; from row 20 on the target is elsewhere, rows 3
    and 8 are outliers."""
    rng = np.random.default_rng(4)
    data = stream(GIVEN, rng, np.arange(1.0, 41.0) / 4)
    x, value = np.asarray(GIVEN.prior.mean), 0.3 * np.asarray(data.value)
    for k, (time, sensor) in enumerate(zip(data.time, data.sensor, strict=True)):
        start = data.time[k - 1] if k else 0.0
        x = GIVEN.oracle["F"](start, time) @ x + GIVEN.oracle["b"](start, time)
        x = x + 60 * (k == 20)
        value[k] += GIVEN.H[sensor] @ x
    value[[3, 8]] += 500
    mask = np.asarray(data.mask).copy()
    mask[::5, 1] = False
    return data._replace(value=value, mask=mask)


@pytest.mark.parametrize("traced", [False, True])
@pytest.mark.parametrize("patience", [2, 4])
def test_it_is_the_loop(shifted, patience, traced):
    level = (lambda params: params) if traced else 0.99
    gate = ej.gated(ej.kalman(GIVEN.model), level, patience)
    trace = go(gate, shifted, jnp.asarray(0.99))
    rows = looped(shifted, 0.99, patience)
    wanted = [USED if row[0] else REJECTED for row in rows]
    np.testing.assert_array_equal(trace.info.status, wanted)
    assert 2 < wanted.count(REJECTED) < 20
    for k, (used, mean, nu, S, _) in enumerate(rows):
        mask = np.asarray(shifted.mask[k])
        np.testing.assert_allclose(trace.mean[k], mean, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(trace.info.innovation[k][mask], nu, rtol=1e-9, atol=1e-9)
        found = trace.info.innovation_cov[k][np.ix_(mask, mask)]
        np.testing.assert_allclose(found, S, rtol=1e-9, atol=1e-9)
        assert (trace.info.log_likelihood[k] == 0) == (not used)
    # It did open, and it did close.
    assert [row[4] == patience for row in rows[:20]] == [False] * 20
    assert rows[20 + patience][4] == patience
    assert rows[-1][4] < patience


@pytest.mark.parametrize(
    "name",
    [pytest.param(n, marks=() if n in ALWAYS else pytest.mark.slow) for n in ESTIMATORS],
)
def test_outliers_are_as_if_they_had_not_come(name):
    estimator = ESTIMATORS[name]()
    found, wanted = go(ej.gated(estimator, LEVEL), WILD), go(estimator, WITHOUT)
    plain = go(estimator, CALM).info.status
    takes_late = plain[2] == LATE
    refused = BAD if takes_late else BAD[:1]
    expected = np.where(np.isin(np.arange(8), refused), REJECTED, plain)
    np.testing.assert_array_equal(found.info.status, expected)
    np.testing.assert_array_equal(found.info.log_likelihood[refused], 0)
    assert np.abs(found.info.innovation[refused]).min() > 1e5
    # The filter goes to the time of a row that it refuses, and not to that of one that is not
    # there: the same in exact arithmetic, but other random numbers are drawn.
    exact = name not in ("ensemble", "bootstrap", "pf_extended")
    for k in range(8 if exact else 3):
        if k not in BAD:
            np.testing.assert_allclose(found.mean[k], wanted.mean[k], rtol=1e-9, atol=1e-9)
            np.testing.assert_allclose(found.cov[k], wanted.cov[k], rtol=1e-8, atol=1e-9)
    assert np.abs(found.mean).max() < 100


@pytest.mark.parametrize("name", ["kalman", "bootstrap", "asd"])
def test_probability_one_is_the_estimator(name):
    estimator = ESTIMATORS[name]()
    found, wanted = go(ej.gated(estimator, 1.0), WILD), go(estimator, WILD)
    for a, b in zip(jax.tree.leaves(found.info), jax.tree.leaves(wanted.info), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(found.mean, wanted.mean, rtol=1e-12, atol=1e-12)


def test_a_replay_of_a_gate_is_the_gate_in_order():
    order = np.argsort(TIMES, kind="stable")
    gate = ej.gated(ej.kalman(GIVEN.model), LEVEL)
    late = go(ej.replay(gate, 8, width=2), WILD)
    sorted_run = go(gate, jax.tree.map(lambda x: x[order], WILD))
    np.testing.assert_allclose(late.mean[-1], sorted_run.mean[-1], rtol=1e-10)
    np.testing.assert_allclose(late.cov[-1], sorted_run.cov[-1], rtol=1e-10)
    assert list(late.info.status[BAD]) == [REJECTED, REJECTED]


def test_a_replay_of_a_gate_opens_when_the_gate_does():
    """What was refused is remembered: a jump of the target locks neither of them out."""
    far = np.where(np.arange(24) >= 10, 50.0, 0.0)[:, None]
    data = ej.stream(np.arange(1.0, 25.0), far)
    model = ej.models.random_walk(q=0.01, sensors=ej.models.position_sensor(1.0))
    gate = ej.gated(ej.kalman(model), LEVEL, 3)
    prior = ej.Gaussian(np.zeros(1), np.eye(1))
    found, wanted = (
        ej.run(method, None, data, prior=prior, t0=0.0) for method in (ej.replay(gate, 4), gate)
    )
    np.testing.assert_array_equal(found.info.status, wanted.info.status)
    np.testing.assert_allclose(found.mean, wanted.mean, rtol=1e-12)
    assert list(wanted.info.status[10:14]) == [REJECTED] * 3 + [USED]
    never = ej.run(ej.replay(ej.gated(ej.kalman(model), LEVEL, None), 4), None, data,
                   prior=prior, t0=0.0)  # fmt: skip
    assert (never.info.status[10:] == REJECTED).all()


@pytest.mark.parametrize("name", ["ewif", "al1"])
def test_a_lock_out_by_late_data_ends(name):
    """Everything comes late, and from row 6 on elsewhere."""
    time = np.repeat(np.arange(1.0, 13.0), 2)
    time[1::2] -= 0.4
    data = stream(GIVEN, np.random.default_rng(0), time)
    far = np.where(np.arange(24) >= 12, 1e4, 0)[:, None]
    data = data._replace(value=0.1 * np.asarray(data.value) + far)
    estimator = ej.ewif(GIVEN.model, 1.0) if name == "ewif" else ej.al1(GIVEN.model, LAG)
    trace, never = (
        go(ej.gated(estimator, 0.999, recover_after=k), data) for k in (3, None)
    )  # fmt: skip
    assert list(trace.info.status[12:15]) == [REJECTED] * 3
    assert trace.info.status[15] in (USED, LATE)
    assert (never.info.status[12:] == REJECTED).all()


def test_nothing_is_refused_while_nothing_is_known():
    data = WILD._replace(value=np.asarray(WILD.value)[::-1].copy(), time=np.sort(TIMES))
    for estimator in (ej.information(GIVEN.model), ej.ewif(GIVEN.model, 2.0)):
        known = go(estimator, data, prior=None)
        unknown = np.isnan(known.info.innovation_cov).any((1, 2))
        assert unknown.any()
        trace = go(ej.gated(estimator, 1e-9, None), data, prior=None)
        assert (trace.info.status[unknown] == USED).all()
        assert (trace.info.status[~unknown] == REJECTED).all()


def test_what_the_estimator_does_not_use_counts_for_nothing():
    gate = ej.gated(ej.kalman(GIVEN.model), LEVEL, 2)
    trace = go(gate, WILD)
    assert trace.info.status[4] == Status.TOO_LATE
    parts = [jax.tree.map(lambda x, k=k: x[:k], WILD) for k in (4, 5, 6)]
    assert [go(gate, part).final_state.outside for part in parts] == [1, 1, 0]


def test_outliers_open_it_as_rarely_as_stated():
    """A state known so well that nothing moves it: rows are outside independently."""
    share, patience, R, T = 0.35, 2, 200, 150
    rng = np.random.default_rng(7)
    value = rng.normal(size=(R, T, 1)) + 1e4 * (rng.random((R, T, 1)) < share)
    still = ej.linear_model(np.eye(1), np.eye(1), np.eye(1))
    prior = ej.Gaussian(np.zeros(1), 1e-14 * np.eye(1))
    data = ej.Measurement(
        np.arange(1.0, T + 1), value, np.zeros(T, np.int32), np.ones((T, 1), bool)
    )
    gate = ej.gated(ej.kalman(still), 0.99, patience)
    info = ej.run_batch(gate, None, data, prior=prior, t0=0.0).info
    outside = np.asarray(info.innovation[..., 0] ** 2) > chi2.ppf(0.99, 1)
    passed = outside & (np.asarray(info.status) == USED)
    s = share + (1 - share) * 0.01
    runs = passed[:, patience:].mean(1)
    assert abs(runs.mean() - s ** (patience + 1)) < 4 * runs.std(ddof=1) / np.sqrt(R)
    # Not one that comes after fewer than two others.
    before = np.lib.stride_tricks.sliding_window_view(outside, patience, 1)[:, :-1].all(-1)
    np.testing.assert_array_equal(passed[:, patience:], outside[:, patience:] & before)
    assert not passed[:, :patience].any()


@pytest.mark.parametrize("name", ["asd", pytest.param("ewif", marks=pytest.mark.slow)])
def test_gradients_are_finite_differences(name):
    model = ej.models.constant_velocity(
        sensors=ej.models.position_sensor(lambda p: p["r"]), q=lambda p: p["q"]
    )
    inside = {
        "asd": lambda: ej.asd(model, 3),
        "ewif": lambda: ej.ewif(model, lambda p: p["q"]),
    }[name]()
    gate = ej.gated(inside, lambda p: p["level"])
    value = np.array([0.1, 1.2, 1e7, 2.2, 3.1, 2.0, 4.2])
    data = ej.stream(np.array([0.5, 1, 1.5, 2, 3, 2.5, 4]), value[:, None])
    prior = ej.Gaussian(np.zeros(2), np.eye(2))
    params = {"q": jnp.asarray(0.7), "r": jnp.asarray(0.4), "level": jnp.asarray(0.999)}

    @jax.jit
    @jax.value_and_grad
    def loss(params):
        trace = ej.run(gate, params, data, prior=prior, t0=0.0)
        return jnp.sum(trace.info.log_likelihood) + jnp.sum(trace.mean) + jnp.sum(trace.cov)

    slope = loss(params)[1]
    assert slope["level"] == 0
    for key in ("q", "r"):
        up, down = (loss(params | {key: params[key] + h})[0] for h in (1e-5, -1e-5))
        np.testing.assert_allclose(slope[key], (up - down) / 2e-5, rtol=1e-5)


def test_float32_and_a_batch_of_runs(shifted):
    gate = ej.gated(ej.kalman(GIVEN.model), 0.99, 2)
    one = go(gate, shifted)
    single = go(gate, shifted._replace(value=np.asarray(shifted.value, np.float32)))
    np.testing.assert_array_equal(single.info.status, one.info.status)
    np.testing.assert_allclose(single.mean, one.mean, rtol=1e-3, atol=1e-3)
    values = np.stack([shifted.value, shifted.value - 60.0])
    both = ej.run_batch(gate, None, shifted._replace(value=values), prior=GIVEN.prior, t0=0.0)
    for k in range(2):
        alone = go(gate, shifted._replace(value=values[k]))
        np.testing.assert_array_equal(both.info.status[k], alone.info.status)
        np.testing.assert_allclose(both.mean[k], alone.mean, rtol=1e-9, atol=1e-9)


def test_what_makes_no_gate_is_refused():
    inside = ej.kalman(GIVEN.model)
    for wrong in (0.0, 1.5, np.nan, [0.9, 0.9]):
        with pytest.raises(ValueError, match="probability: expected"):
            ej.gated(inside, wrong)
        with pytest.raises(ValueError, match="probability: expected"):
            go(ej.gated(inside, lambda p: p), CALM, wrong)
    with pytest.raises(ValueError, match="recover_after: expected a whole number >= 1"):
        ej.gated(inside, recover_after=0)
    with pytest.raises(ValueError, match="estimator: expected an Estimator"):
        ej.gated(GIVEN.model)
