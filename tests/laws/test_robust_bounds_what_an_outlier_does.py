"""A robust filter is the plain one with R / w^2 (a loop in NumPy), the plain one as c grows, and
moves no further than its bound; with outliers it is better than the plain one."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from late_streams import problem, stream

import ewif_jax as ej
from ewif_jax import Status

GIVEN = problem(0, 2, m=2)
LAG, SIZE, C = 6, 30, 1.7
KINDS = ("weight", "huber", "student")
TIMES = np.array([0.5, 1.0, 0.8, 1.5, 1.2, 2.0, 2.4, 2.2])
CALM = stream(GIVEN, np.random.default_rng(2), TIMES)
IN_ORDER = CALM._replace(time=np.sort(TIMES))
PARTIAL = IN_ORDER._replace(mask=IN_ORDER.mask & ~(np.arange(16).reshape(8, 2) % 5 == 1))
ESTIMATORS = {
    "kalman": lambda: ej.kalman(GIVEN.model),
    "square_root": lambda: ej.square_root(GIVEN.model),
    "information": lambda: ej.information(GIVEN.model),
    "fading": lambda: ej.fading(GIVEN.model, 1.1),
    "ewif": lambda: ej.ewif(GIVEN.model, 2.0),
    "ewif_bank": lambda: ej.ewif_bank(GIVEN.model, (1.0, 3.0)),
    "extended": lambda: ej.extended(GIVEN.model),
    "unscented": lambda: ej.unscented(GIVEN.model),
    "iterated_extended": lambda: ej.iterated_extended(GIVEN.model),
    "nonlinear ewif": lambda: ej.ewif(GIVEN.model, 2.0, linearisation="extended"),
    "guided": lambda: ej.guided(GIVEN.model, SIZE),
    "ensemble": lambda: ej.ensemble(GIVEN.model, SIZE),
    "enkf2": lambda: ej.enkf2(GIVEN.model, SIZE, LAG),
    "bootstrap": lambda: ej.bootstrap(GIVEN.model, SIZE),
    "pf_extended": lambda: ej.pf_extended(GIVEN.model, SIZE, LAG),
    "al1": lambda: ej.al1(GIVEN.model, LAG),
    "asd": lambda: ej.asd(GIVEN.model, LAG),
    "rts_reference": lambda: ej.rts_reference(GIVEN.model, LAG),
    "replay": lambda: ej.replay(ej.kalman(GIVEN.model), LAG, width=2),
    "selective": lambda: ej.selective(ej.al1(GIVEN.model, LAG), 0.25, softness=0.1),
    "gated": lambda: ej.gated(ej.asd(GIVEN.model, LAG), 1 - 1e-9),
    "drop_late": lambda: ej.drop_late(ej.ewif(GIVEN.model, 2.0)),
    "fixed_lag_ewif": lambda: ej.fixed_lag_ewif(GIVEN.model, 2.0, lag=0.3),
}
ALWAYS = ("ewif", "ensemble", "bootstrap", "asd", "replay", "selective")
NEEDS_KEY = ("ensemble", "enkf2", "bootstrap", "guided", "pf_extended")


def go(estimator, data, params=None, prior=GIVEN.prior, key=None):
    return ej.run(estimator, params, data, prior=prior, t0=0.0, key=key)


def weight(kind, c, square, m):
    """w^2."""
    if kind == "weight":
        return 1 / (1 + square / c**2)
    if kind == "huber":
        return min(1.0, c / np.sqrt(square))
    return (c + m) / (c + square)


def looped(data, kind, c):
    """Means, covariances, innovations, their covariances, log likelihoods; in NumPy."""
    t, x, P = 0.0, np.asarray(GIVEN.prior.mean), np.asarray(GIVEN.prior.cov)
    motion, rows = GIVEN.oracle, []
    for time, z, sensor, mask in zip(*map(np.asarray, data), strict=True):
        F, Q, b = (motion[name](t, time) for name in "FQb")
        t, x, P = time, F @ x + b, F @ P @ F.T + Q
        H, R = GIVEN.H[sensor][mask], GIVEN.R[sensor][np.ix_(mask, mask)]
        nu = z[mask] - H @ x
        S = H @ P @ H.T + R / weight(kind, c, nu @ np.linalg.solve(R, nu), len(nu))
        K = P @ H.T @ np.linalg.inv(S)
        density = -0.5 * (nu @ np.linalg.solve(S, nu) + np.linalg.slogdet(2 * np.pi * S)[1])
        plain = H @ P @ H.T + R
        x, P = x + K @ nu, P - K @ S @ K.T
        rows.append((x, P, nu, plain, density))
    return rows


@pytest.mark.parametrize("kind", KINDS)
def test_it_is_the_loop(kind):
    value = np.array(PARTIAL.value)
    value[4] += 50
    data = PARTIAL._replace(value=value)
    trace = go(ej.robust(ej.kalman(GIVEN.model), lambda p: p, kind), data, jnp.asarray(C))
    for k, (mean, cov, nu, S, density) in enumerate(looped(data, kind, C)):
        mask = np.asarray(data.mask[k])
        np.testing.assert_allclose(trace.mean[k], mean, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(trace.cov[k], cov, rtol=1e-8, atol=1e-10)
        np.testing.assert_allclose(trace.info.innovation[k][mask], nu, rtol=1e-9, atol=1e-9)
        found = trace.info.innovation_cov[k][np.ix_(mask, mask)]
        np.testing.assert_allclose(found, S, rtol=1e-9)
        np.testing.assert_allclose(trace.info.log_likelihood[k], density, rtol=1e-9)
    assert (trace.info.status == Status.USED).all()


@pytest.mark.parametrize("kind", KINDS)
def test_an_ewif_weighs_the_information_of_late_data_too(kind):
    """The sum (19) of the paper of EWIF, each term times w^2 of its innovation."""
    tau, value = 2.0, np.array(CALM.value)
    value[4] += 50
    data = CALM._replace(value=value)
    trace = go(ej.robust(ej.ewif(GIVEN.model, tau), C, kind), data)
    F, b = GIVEN.oracle["F"], GIVEN.oracle["b"]
    now, x = 0.0, np.asarray(GIVEN.prior.mean)
    Y = np.linalg.inv(np.asarray(GIVEN.prior.cov))
    for k, (time, z, sensor, _) in enumerate(zip(*map(np.asarray, data), strict=True)):
        if time > now:
            back = np.linalg.inv(F(now, time))
            x, Y = F(now, time) @ x + b(now, time), back.T @ Y @ back * np.exp((now - time) / tau)
            now = time
        back = np.linalg.inv(F(time, now))
        H, R = GIVEN.H[sensor] @ back, GIVEN.R[sensor]
        nu = z - H @ (x - b(time, now))
        share = weight(kind, C, nu @ np.linalg.solve(R, nu), 2) * np.exp((time - now) / tau)
        told = share * H.T @ np.linalg.inv(R)
        Y = Y + told @ H
        x = x + np.linalg.solve(Y, told @ nu)
        np.testing.assert_allclose(trace.info.innovation[k], nu, rtol=1e-7, atol=1e-8)
        np.testing.assert_allclose(trace.mean[k], x, rtol=1e-7, atol=1e-8)
        np.testing.assert_allclose(trace.cov[k], np.linalg.inv(Y), rtol=1e-7, atol=1e-8)
    assert trace.info.status[4] == Status.LATE_USED


@pytest.mark.parametrize(
    "name",
    [pytest.param(n, marks=() if n in ALWAYS else pytest.mark.slow) for n in ESTIMATORS],
)
def test_a_large_c_is_the_estimator_and_a_small_one_is_not(name):
    estimator = ESTIMATORS[name]()
    key = jax.random.key(3) if name in NEEDS_KEY else None
    kind = KINDS[len(name) % 3]
    plain = go(estimator, CALM, key=key)
    robust = ej.robust(estimator, lambda p: p, kind)
    large, small = (go(robust, CALM, jnp.asarray(c), key=key) for c in (1e12, 1.0))
    np.testing.assert_allclose(large.mean, plain.mean, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(large.cov, plain.cov, rtol=1e-9, atol=1e-9)
    for a, b in zip(jax.tree.leaves(large.info), jax.tree.leaves(plain.info), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-9)
    np.testing.assert_array_equal(small.info.status, plain.info.status)
    used = small.info.status <= Status.LATE_USED
    assert np.abs(small.mean - plain.mean)[used].max() > 1e-3


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_an_outlier_moves_the_mean_no_further_than_the_bound(kind, dtype):
    prior = ej.Gaussian(*(jnp.asarray(x, dtype) for x in GIVEN.prior))
    start = ej.Measurement(*(np.asarray(x)[:1] for x in IN_ORDER))._replace(time=np.zeros(1))
    sizes = np.array([0.3, 1, 3, 10, 1e2, 1e4, 1e6, 1e12, 1e16])
    value = sizes[:, None, None] * np.array([0.6, -0.8])
    batch = ej.Measurement(
        np.zeros(1, dtype), value.astype(dtype), start.sensor, np.ones((1, 2), bool)
    )
    estimator = ej.robust(ej.kalman(GIVEN.model), C, kind)
    found = ej.run_batch(estimator, None, batch, prior=prior, t0=0.0).mean[:, 0]
    moved = np.linalg.norm(np.asarray(found) - np.asarray(prior.mean), axis=-1)
    H, R = GIVEN.H[start.sensor[0]], GIVEN.R[start.sensor[0]]
    gain = np.asarray(GIVEN.prior.cov) @ H.T @ scipy.linalg.inv(scipy.linalg.sqrtm(R))
    reach = {"weight": C / 2, "huber": C, "student": (C + 2) / (2 * np.sqrt(C))}[kind]
    assert np.all(moved <= np.linalg.norm(gain, 2) * reach * (1 + 1e-5))
    assert moved.max() > 0.02 * np.linalg.norm(gain, 2) * reach
    if kind == "huber":
        np.testing.assert_allclose(moved[-1], moved[-3], rtol=1e-3)
    else:
        assert moved[-3] < 1e-2 * moved.max()


@pytest.mark.parametrize("kind", KINDS)
def test_with_outliers_it_is_better_than_the_plain_filter(kind):
    R, T, rng = 60, 80, np.random.default_rng(0)
    model = ej.models.constant_velocity(sensors=ej.models.position_sensor(1.0), q=0.05)
    speed = np.cumsum(np.sqrt(0.05) * rng.normal(size=(R, T)), 1)
    truth = np.cumsum(speed, 1)
    noise = rng.normal(size=(R, T)) * np.where(rng.random((R, T)) < 0.05, 20.0, 1.0)
    late = np.argsort(np.arange(T) + 2.5 * (rng.random(T) < 0.2), kind="stable")
    time = np.arange(1.0, T + 1)[late]
    value = (truth + noise)[:, late, None]
    data = ej.Measurement(time, value, np.zeros(T, np.int32), np.ones((T, 1), bool))
    newest = np.maximum.accumulate(time).astype(int) - 1
    prior = ej.Gaussian(np.zeros(2), np.eye(2))
    plain = ej.asd(model, 5)
    mean = [
        np.asarray(ej.run_batch(e, None, data, prior=prior, t0=0.0).mean[..., 0])
        for e in (plain, ej.robust(plain, 3.0, kind))
    ]
    errors = [np.sqrt(((m - truth[:, newest]) ** 2).mean(1)) for m in mean]
    gain = errors[0] - errors[1]
    assert gain.mean() > 5 * gain.std(ddof=1) / np.sqrt(R)


def test_a_replay_weighs_anew_in_order():
    order = np.argsort(TIMES, kind="stable")
    robust = ej.robust(ej.kalman(GIVEN.model), C)
    outside = ej.robust(ej.replay(ej.kalman(GIVEN.model), 8, width=2), C)
    inside = ej.replay(robust, 8, width=2)
    late, also = go(inside, CALM), go(outside, CALM)
    in_order = go(robust, jax.tree.map(lambda x: x[order], CALM))
    np.testing.assert_allclose(late.mean[-1], in_order.mean[-1], rtol=1e-10)
    np.testing.assert_allclose(also.mean, late.mean, rtol=1e-12)
    np.testing.assert_allclose(also.cov, late.cov, rtol=1e-12)


@pytest.mark.parametrize("kind", KINDS)
def test_gradients_are_finite_differences(kind):
    model = ej.models.constant_velocity(
        sensors=ej.models.position_sensor(lambda p: p["r"]), q=lambda p: p["q"]
    )
    value = np.array([0.1, 1.2, 1e3, 2.2, 3.1, 2.0, 4.2])
    data = ej.stream(np.array([0.5, 1, 1.5, 2, 3, 2.5, 4]), value[:, None])
    prior = ej.Gaussian(np.zeros(2), np.eye(2))
    params = {"q": jnp.asarray(0.7), "r": jnp.asarray(0.4), "c": jnp.asarray(2.2)}
    inside = ej.asd(model, 3) if kind == "weight" else ej.kalman(model)
    estimator = ej.robust(inside, lambda p: p["c"], kind)

    @jax.jit
    @jax.value_and_grad
    def loss(params):
        trace = ej.run(estimator, params, data, prior=prior, t0=0.0)
        return jnp.sum(trace.info.log_likelihood) + jnp.sum(trace.mean) + jnp.sum(trace.cov)

    slope = loss(params)[1]
    for name in params:
        up, down = (loss(params | {name: params[name] + h})[0] for h in (1e-5, -1e-5))
        np.testing.assert_allclose(slope[name], (up - down) / 2e-5, rtol=2e-5, atol=1e-6)


def test_a_batch_is_its_runs_and_nothing_known_is_no_outlier():
    robust = ej.robust(ej.ewif(GIVEN.model, 2.0), C)
    values = np.stack([CALM.value, np.asarray(CALM.value) + 10.0])
    both = ej.run_batch(robust, None, CALM._replace(value=values), prior=None, t0=0.0)
    for k in range(2):
        alone = go(robust, CALM._replace(value=values[k]), prior=None)
        np.testing.assert_allclose(both.mean[k], alone.mean, rtol=1e-9, atol=1e-9)
    plain = go(ej.ewif(GIVEN.model, 2.0), CALM, prior=None)
    unknown = np.isnan(plain.info.innovation).any(1)
    assert unknown.any()
    np.testing.assert_array_equal(both.info.log_likelihood[0][unknown], 0)


def test_offsets_and_jitter_of_a_model_stay_what_they_are():
    """A velocity of 3 m/s and stamps uncertain by 0.5 s are noise of 1.5 m; a bias is none."""
    sensor = ej.models.biased(ej.models.position_sensor(1.0), lambda p: p["bias"])
    exact = ej.models.constant_velocity(sensors=sensor, q=0.1)
    wide = ej.models.constant_velocity(sensors=ej.models.position_sensor(1.0 + 1.5**2), q=0.1)
    prior = ej.Gaussian(np.array([1.0, 3.0]), np.diag([2.0, 0.5]))
    params = {"bias": jnp.asarray(20.0)}
    for kind in KINDS:
        found, wanted = (
            go(ej.robust(ej.kalman(model), C, kind), ej.stream([0.0], [[z]]), params, prior)
            for model, z in ((ej.models.jittered(exact, 0.5), 27.0), (wide, 7.0))
        )
        np.testing.assert_allclose(found.mean, wanted.mean, rtol=1e-12)
        np.testing.assert_allclose(found.cov, wanted.cov, rtol=1e-12)


def test_equal_ones_are_equal():
    def make():
        return ej.robust(ej.replay(ej.kalman(GIVEN.model), 3), 2.0)

    assert make() == make()
    assert "robust(replay(" in repr(make())


def test_what_cannot_be_made_robust_is_refused():
    inside = ej.kalman(GIVEN.model)
    with pytest.raises(ValueError, match="c: expected a positive number"):
        ej.robust(inside, 0.0)
    with pytest.raises(ValueError, match="c: expected a positive number"):
        go(ej.robust(inside, lambda p: p), CALM, -1.0)
    with pytest.raises(ValueError, match="kind: expected one of weight, huber, student"):
        ej.robust(inside, 1.0, "tukey")
    with pytest.raises(ValueError, match="estimator: expected an Estimator"):
        ej.robust(GIVEN.model, 1.0)
    with pytest.raises(ValueError, match="one that a builder made of a Model"):
        ej.robust(ej.Estimator(*inside[:4]), 1.0)
    key = jax.random.key(0)
    for keeps in (ej.limited_memory(GIVEN.model, 1.0, 4), ej.pf_fixed_point(GIVEN.model, 9, 2)):
        with pytest.raises(ValueError, match=r"that it keeps, got (limited_memory|pf_fixed_point)"):
            go(ej.robust(keeps, 1.0), CALM, key=key)
