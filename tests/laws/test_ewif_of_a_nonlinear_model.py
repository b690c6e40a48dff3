"""EWIF with straight lines for a nonlinear model: what it equals, and what is left of Theorem 4."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import ewif_jax as ej
from laws.cases import case, close, model

KINDS = ("extended", "sigma-points")
FUNCTIONS = ej.Model(
    model().transition, model().process_cov, model().observe, model().measurement_cov
)
"""The linear worlds of the laws, as functions."""
PARAMS = {"tau": 1.3, "r": 0.02}
PRIOR = ej.Gaussian(np.array([0.9, -0.3]), np.array([[0.05, 0.02], [0.02, 0.08]]))


def tau_of(params):
    return params["tau"]


def swirled(xp, x, dt):
    """A rotation, the faster the farther out: it can be followed back exactly."""
    turn = (0.8 + 0.3 * (x[0] ** 2 + x[1] ** 2)) * dt
    c, s = xp.cos(turn), xp.sin(turn)
    return xp.stack([c * x[0] - s * x[1], s * x[0] + c * x[1]])


def shown(xp, x):
    """A bearing and a distance, both from outside."""
    return xp.stack([xp.arctan2(x[1], x[0] - 1.5), xp.sqrt((x[0] + 2.0) ** 2 + (x[1] - 1.0) ** 2)])


def wrapped(angle):
    return np.angle(np.exp(1j * angle))


SWIRL = ej.Model(
    lambda p, x, t0, t1: swirled(jnp, x, t1 - t0),
    lambda p, t0, t1: jnp.zeros((2, 2)),
    lambda p, x, s, t: shown(jnp, x)[s][None],
    lambda p, s, t: p["r"] * jnp.ones((1, 1)),
    residual=lambda z, y, s: jnp.where(s == 0, ej.models.wrap_angle(z - y), z - y),
)
BUILT = {kind: ej.ewif(SWIRL, tau_of, linearisation=kind) for kind in KINDS}
TIMES = np.array([0.4, 0.9, 0.7, 1.6, 0.2, 1.6, 2.1])
SENSORS = np.array([0, 1, 0, 1, 0, 0, 1])
ERRORS = np.array([0.9, -0.4, -1.2, 0.3, 0.8, -0.6, 1.1])


def stream(share=1.0, order=slice(None), dtype=np.float64):
    """What the prior's mean would show, off by a share of the noise."""
    path = [shown(np, swirled(np, PRIOR.mean, t)) for t in TIMES]
    value = np.array([y[s] for y, s in zip(path, SENSORS, strict=True)])
    value = value + share * np.sqrt(PARAMS["r"]) * ERRORS
    value = np.where(SENSORS == 0, wrapped(value), value)
    return ej.stream(TIMES[order].astype(dtype), value[order, None].astype(dtype), SENSORS[order])


def filtered(kind, data=None, params=PARAMS, prior=PRIOR):
    return ej.run(BUILT[kind], params, stream() if data is None else data, prior=prior, t0=0.0)


def line(kind, f, x, P, apart):
    """f(x), slope, and what is left over, by NumPy."""
    if kind == "extended":
        h = 1e-6
        slope = [apart(f(x + e), f(x - e)) / (2 * h) for e in h * np.eye(2)]
        return f(x), np.array(slope).T, 0.0
    flip = np.eye(2)[::-1]
    root = flip @ np.linalg.cholesky(flip @ P @ flip) @ flip
    offsets = np.sqrt(2) * np.concatenate([root.T, -root.T])
    values = np.array([apart(f(x + e), f(x)) for e in offsets])
    shift = values.mean(0)
    slope = np.linalg.solve(P, offsets.T @ (values - shift) / 4).T
    left = (values - shift).T @ (values - shift) / 4 - slope @ P @ slope.T
    return f(x) + shift, slope, left


def loop(kind, tau=PARAMS["tau"], r=PARAMS["r"]):
    """In covariance form, with gains: motion, then each measurement from the newest time."""
    x, P, now, found = PRIOR.mean, PRIOR.cov, 0.0, []
    data = zip(TIMES, np.asarray(stream().value)[:, 0], SENSORS, strict=True)
    for t, z, s in data:
        if t > now:
            dt, now = t - now, t
            x, F, left = line(kind, lambda y, dt=dt: swirled(np, y, dt), x, P, np.subtract)
            P = np.exp(dt / tau) * F @ P @ F.T + left

        def see(y, age=now - t, s=s):
            return shown(np, swirled(np, y, -age))[s : s + 1]

        turn = wrapped if s == 0 else np.asarray
        y, H, left = line(kind, see, x, P, lambda a, b, turn=turn: turn(a - b))
        S = H @ P @ H.T + r * np.exp((now - t) / tau) + left
        K = P @ H.T / S
        x, P = x + K @ turn(np.array([z]) - y), P - K @ S @ K.T
        found.append((x, P, S[0, 0]))
    return found


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_it_is_a_loop_in_covariance_form(kind, dtype):
    """Late measurements (rows 2 and 4), two at one time, angles beyond the cut."""
    prior = ej.Gaussian(*(x.astype(dtype) for x in PRIOR))
    trace = ej.run(BUILT[kind], PARAMS, stream(dtype=dtype), prior=prior, t0=dtype(0))
    expected = loop(kind)
    tolerance = {np.float32: 2e-4, np.float64: 1e-8}[dtype]
    assert trace.mean.dtype == dtype
    close(trace.mean, [x for x, *_ in expected], tolerance)
    close(trace.cov, [P for _, P, _ in expected], tolerance)
    close(trace.info.innovation_cov[:, 0, 0], [S for *_, S in expected], tolerance)
    late = [k for k, status in enumerate(trace.info.status) if status == ej.Status.LATE_USED]
    assert late == [2, 4]


@pytest.mark.parametrize("kind", KINDS)
def test_of_a_linear_model_it_is_the_ewif_of_its_matrices(kind):
    """Written as functions; partial masks, and late ones."""
    world = case(5, 3)
    order = np.array([0, 3, 1, 2, 6, 5, 4, 9, 7, 8])
    options = {"prior": world.prior, "t0": 0.0}
    plain = ej.ewif(model(), tau_of)
    expected = ej.run(plain, world.params, world.stream(order), **options)
    functions = ej.ewif(FUNCTIONS, tau_of, linearisation=kind)
    found = ej.run(functions, world.params, world.stream(order), **options)
    for a, b in ((found.mean, expected.mean), (found.cov, expected.cov)):
        close(a, b, 1e-9)
    close(found.info.log_likelihood, expected.info.log_likelihood, 1e-9)
    np.testing.assert_array_equal(found.info.status, expected.info.status)
    same = ej.run(
        ej.ewif(model(), tau_of, linearisation=kind), world.params, world.stream(order), **options
    )
    np.testing.assert_array_equal(same.mean, expected.mean)


IN_ORDER = np.argsort(TIMES, kind="stable")


def test_as_tau_grows_it_is_the_extended_filter_without_process_noise():
    data, endless = stream(order=IN_ORDER), {**PARAMS, "tau": 1e9}
    expected = ej.run(ej.extended(SWIRL), endless, data, prior=PRIOR, t0=0.0)
    found = filtered("extended", data, endless)
    close(found.mean, expected.mean, 1e-7)
    close(found.cov, expected.cov, 1e-7)
    close(found.info.log_likelihood, expected.info.log_likelihood, 1e-6)


def test_of_one_state_and_as_tau_grows_sigma_points_are_the_unscented_filter():
    """With more states its points are another square root of the same covariance."""
    bent = ej.Model(
        lambda p, x, t0, t1: x * jnp.exp(-0.2 * (t1 - t0)) + 0.3 * jnp.sin(t1 - t0) * jnp.cos(x),
        lambda p, t0, t1: jnp.zeros((1, 1)),
        lambda p, x, s, t: jnp.exp(0.5 * x),
        lambda p, s, t: jnp.full((1, 1), 0.1),
    )
    data = ej.stream(np.array([0.3, 0.9, 1.5]), np.array([[1.8], [1.1], [1.5]]))
    options = {"prior": ej.Gaussian(np.array([0.4]), np.array([[0.3]])), "t0": 0.0}
    expected = ej.run(ej.unscented(bent), None, data, **options)
    found = ej.run(ej.ewif(bent, 1e9, linearisation="sigma-points"), None, data, **options)
    close(found.mean, expected.mean, 1e-7)
    close(found.cov, expected.cov, 1e-7)


ORDERS = (IN_ORDER, np.array([3, 1, 6, 0, 2, 5, 4]), np.arange(7)[::-1])


def at_the_end(kind, share, order):
    """Mean and covariance at 2.1 s."""
    trace = filtered(kind, stream(share, order))
    assert trace.time[-1] == TIMES.max()
    return np.asarray(trace.mean[-1]), np.asarray(trace.cov[-1])


def test_in_any_order_where_the_lines_are_drawn_at_the_same_points():
    """Theorem 4: measurements that say what was expected move no mean, so every line touches the
    same path, whatever came first; then order does not matter at all."""
    first, *others = (at_the_end("extended", 0.0, order) for order in ORDERS)
    for other in others:
        close(other[0], first[0], 1e-12)
        close(other[1], first[1], 1e-10)


def apart(kind, share):
    """The largest difference between orders, as a share of the estimate's standard deviation."""
    first, *others = (at_the_end(kind, share, order) for order in ORDERS)
    std = np.sqrt(np.diag(first[1]))
    return max(np.abs((mean - first[0]) / std).max() for mean, _ in others)


def test_otherwise_the_order_matters_to_second_order():
    """A quarter of the difference is left of half the noise; 0.12 at about one standard deviation
    a measurement. Sigma points differ also where measurements say what was expected."""
    full, half, quarter = (apart("extended", share) for share in (1.0, 0.5, 0.25))
    assert 0.11 < full < 0.13
    assert 3.7 < half / quarter < 4.3
    assert 0.3 < apart("sigma-points", 0.0) < 0.4


@pytest.mark.parametrize("kind", ["extended", pytest.param("sigma-points", marks=pytest.mark.slow)])
def test_batches_are_runs_and_gradients_are_quotients(kind):
    streams = [stream(), stream(0.3, order=IN_ORDER)]
    both = jax.tree.map(lambda *x: jnp.stack(x), *streams)
    batch = ej.run_batch(BUILT[kind], PARAMS, both, prior=PRIOR, t0=0.0)
    for k, data in enumerate(streams):
        alone = filtered(kind, data)
        close(batch.mean[k], alone.mean, 1e-12)
        np.testing.assert_array_equal(batch.info.status[k], alone.info.status)

    def loss(params):
        trace = filtered(kind, params=params)
        return jnp.sum(trace.mean**2) + jnp.sum(trace.cov) + jnp.sum(trace.info.log_likelihood)

    both_of = jax.jit(jax.value_and_grad(loss))
    slopes = both_of(PARAMS)[1]
    for name, x in PARAMS.items():
        up, down = (both_of({**PARAMS, name: x * (1 + h)})[0] for h in (1e-6, -1e-6))
        np.testing.assert_allclose(slopes[name], (up - down) / (2e-6 * x), rtol=1e-6)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_after_a_gap_that_forgets_everything_new_measurements_start_again(kind, dtype):
    """NaN until two of them determine the state, on lines where the last estimate leads."""
    times = np.array([0.5, 1300.0, 1300.0, 1300.1])
    where = swirled(np, PRIOR.mean, dtype(1300.0) - 0.0)
    there = [shown(np, x) for x in (swirled(np, PRIOR.mean, 0.5), where, where)]
    there.append(shown(np, swirled(np, where, 0.1)))
    value = np.array([[y[s]] for y, s in zip(there, (0, 0, 1, 1), strict=True)])
    data = ej.stream(times.astype(dtype), value.astype(dtype), np.array([0, 0, 1, 1]))
    prior = ej.Gaussian(*(x.astype(dtype) for x in PRIOR))
    trace = ej.run(BUILT[kind], {**PARAMS, "r": 1e-4}, data, prior=prior, t0=dtype(0))
    assert np.isnan(trace.mean[1]).all()
    assert np.isfinite(trace.mean[np.array([0, 2, 3])]).all()
    assert np.isfinite(trace.cov[3]).all()
    assert (np.asarray(trace.info.status) == ej.Status.USED).all()
    if dtype == np.float64 and kind == "extended":
        close(trace.mean[3], swirled(np, where, 0.1), 1e-6)


def test_what_cannot_be_is_refused():
    with pytest.raises(ValueError, match=r"ewif needs F and H \(give `linearisation`, 'extended'"):
        ej.ewif(SWIRL, 1.0)
    with pytest.raises(ValueError, match="linearisation: expected one of"):
        ej.ewif(SWIRL, 1.0, linearisation="unscented")
    with pytest.raises(ValueError, match="model: expected a Model"):
        ej.ewif(PARAMS, 1.0, linearisation="extended")
    with pytest.raises(ValueError, match=r"prior: .* ewif .* to linearise at, got None"):
        BUILT["extended"].init(PARAMS, None, 0.0)


def test_what_is_not_a_number_is_refused_and_changes_nothing():
    """A sensor that says nothing of where the state was then; gradients are finite."""
    half = SWIRL._replace(observe=lambda p, x, s, t: jnp.where(t < 0.3, jnp.nan, x[:1]))
    for kind in KINDS:
        built = ej.ewif(half, tau_of, linearisation=kind)

        def told(tau, built=built):
            params = {**PARAMS, "tau": tau}
            state = built.predict(params, built.init(params, PRIOR, 0.0), 1.0)
            z = ej.Measurement(jnp.asarray(0.2), jnp.zeros(1), jnp.int32(1), jnp.array([True]))
            after, info = built.update(params, state, z)
            return jnp.sum(built.estimate(params, after).cov), (state, after, info)

        slope, (state, after, info) = jax.jit(jax.grad(told, has_aux=True))(1.3)
        assert info.status == ej.Status.REJECTED
        jax.tree.map(np.testing.assert_array_equal, after, state)
        assert np.isfinite(slope)
        assert all(np.isfinite(x).all() for x in info)
