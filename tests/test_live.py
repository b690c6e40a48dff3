"""Filtering as measurements come in is filtering a stream: one arrival, or one of many tracks."""

import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import ewif_jax as ej

TRACKS, ROWS = 5, 6
SENSOR = ej.models.position_sensor(lambda p: p["r"], dims=2)
MODEL = ej.models.constant_velocity(sensors=SENSOR, q=lambda p: p["q"], dims=2)
PARAMS = {"q": 0.3, "r": 0.5, "tau": 3.0}
PRIOR = ej.Gaussian(np.zeros(4), np.eye(4))
METHODS = {
    "kalman": ej.kalman(MODEL),
    "ewif": ej.ewif(MODEL, lambda p: p["tau"]),
    "al1": ej.al1(MODEL, 4),
    "replay": ej.replay(ej.kalman(MODEL), 4),
}


def late_tracks():
    """Times of their own, some late, some rows missing, one that is no number."""
    rng = np.random.default_rng(3)
    times = np.arange(1.0, ROWS + 1) + rng.uniform(-1.4, 0.4, (TRACKS, ROWS))
    values = rng.normal(size=(TRACKS, ROWS, 2))
    mask = rng.uniform(size=(TRACKS, ROWS)) > 0.2
    values[1, 2] = 1e200
    sensor = np.zeros((TRACKS, ROWS), int)
    return ej.Measurement(times, values, sensor, np.repeat(mask[..., None], 2, -1))


TRACKS_AT_ONCE = late_tracks()
BY_TIME = jax.tree.map(lambda x: np.swapaxes(x, 0, 1), TRACKS_AT_ONCE)


def agree(found, wanted):
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-11), found, wanted
    )


@pytest.mark.parametrize("name", METHODS)
def test_one_arrival_at_a_time_is_the_run(name):
    est, one = METHODS[name], jax.tree.map(lambda x: x[1], TRACKS_AT_ONCE)
    trace = ej.run(est, PARAMS, one, prior=PRIOR, t0=0.0)
    state = est.init(PARAMS, PRIOR, 0.0)
    for k, arrival in enumerate(ej.arrivals(one)):
        state, info = ej.step(est, PARAMS, state, arrival)
        agree(info, jax.tree.map(lambda x, k=k: x[k], trace.info))
    agree(state, trace.final_state)


@pytest.mark.parametrize("name", METHODS)
@pytest.mark.parametrize("per_run", [False, True], ids=["shared", "per_run"])
def test_many_tracks_are_each_by_itself(name, per_run):
    est = METHODS[name]
    scale = np.linspace(0.5, 2.0, TRACKS) if per_run else 1.0
    params = {key: value * scale for key, value in PARAMS.items()}
    start = {"prior": PRIOR, "t0": 0.0, "params_per_run": per_run}
    whole = ej.run_batch(est, params, TRACKS_AT_ONCE, **start)
    begin = jax.vmap(
        lambda p: est.init(p, PRIOR, 0.0), axis_size=TRACKS, in_axes=0 if per_run else None
    )
    state = begin(params)
    for k, arrival in enumerate(ej.arrivals(BY_TIME)):
        state, info = ej.step_batch(est, params, state, arrival, params_per_run=per_run)
        agree(info, jax.tree.map(lambda x, k=k: x[:, k], whole.info))
    agree(state, whole.final_state)


def test_inside_other_programs_they_are_part_of_them():
    est = METHODS["kalman"]
    first = next(ej.arrivals(BY_TIME))
    start = est.init(PARAMS, PRIOR, 0.0)
    states = jax.tree.map(lambda x: jnp.broadcast_to(x, (TRACKS, *x.shape)), start)
    each = jax.vmap(lambda s, m: ej.step(est, PARAMS, s, m))(states, first)
    agree(ej.step_batch(est, PARAMS, states, first), each)

    def loss(q):
        state, info = ej.step_batch(est, {**PARAMS, "q": q}, states, first)
        return jnp.sum(state.mean**2) + jnp.sum(info.log_likelihood)

    slope = jax.jit(jax.grad(loss))(0.3)
    h = 1e-5
    np.testing.assert_allclose(slope, (loss(0.3 + h) - loss(0.3 - h)) / (2 * h), rtol=1e-6)


def test_a_shared_time_is_one_for_all_tracks():
    est = METHODS["al1"]
    start = est.init(PARAMS, PRIOR, 0.0)
    states = jax.tree.map(lambda x: jnp.broadcast_to(x, (TRACKS, *x.shape)), start)
    first = next(ej.arrivals(BY_TIME))
    shared = first._replace(time=np.array(1.5), sensor=np.array(0))
    own = first._replace(time=np.full(TRACKS, 1.5))
    agree(ej.step_batch(est, PARAMS, states, shared), ej.step_batch(est, PARAMS, states, own))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"value": np.zeros((3, 2))}, "state.*3 runs"),
        ({"time": np.zeros(4)}, r"measurement\.time.*5 runs"),
        ({"sensor": np.full(TRACKS, 2)}, r"measurement\.sensor"),
        ({"value": np.zeros(2)}, r"measurement\.value"),
    ],
    ids=["tracks", "times", "sensor", "one_track"],
)
def test_what_does_not_fit_is_named(change, message):
    est = METHODS["kalman"]
    start = est.init(PARAMS, PRIOR, 0.0)
    states = jax.tree.map(lambda x: jnp.broadcast_to(x, (TRACKS, *x.shape)), start)
    first = next(ej.arrivals(BY_TIME))
    with pytest.raises(ValueError, match=message):
        ej.step_batch(est, PARAMS, states, first._replace(**change))


def test_parameters_that_are_no_variances_are_refused():
    est = METHODS["kalman"]
    start = est.init(PARAMS, PRIOR, 0.0)
    first = next(ej.arrivals(jax.tree.map(lambda x: x[0], TRACKS_AT_ONCE)))
    with pytest.raises(ValueError, match="q: expected"):
        ej.step(est, {**PARAMS, "q": -1.0}, start, first)
    states = jax.tree.map(lambda x: jnp.broadcast_to(x, (TRACKS, *x.shape)), start)
    bad = {**PARAMS, "r": np.array([1.0, 1.0, -1.0, 1.0, 1.0])}
    of_r = {"q": False, "r": True, "tau": False}
    with pytest.raises(ValueError, match="r: expected"):
        ej.step_batch(est, bad, states, next(ej.arrivals(BY_TIME)), params_per_run=of_r)


def test_a_stream_gives_its_arrivals_at_no_cost():
    stream = ej.stream(np.arange(10_000.0), np.zeros((10_000, 2)))
    begin = time.process_time()
    count = sum(1 for _ in ej.arrivals(stream))
    assert count == 10_000
    assert time.process_time() - begin < 1.0


@pytest.mark.parametrize("name", METHODS)
def test_a_forecast_is_the_motion_from_the_state(name):
    one = jax.tree.map(lambda x: x[1], TRACKS_AT_ONCE)
    state = ej.run(METHODS[name], PARAMS, one, prior=PRIOR, t0=0.0).final_state
    mean, cov = METHODS[name].estimate(PARAMS, state)
    ahead = np.array([0.5, 4.0, 1.0])
    found = ej.forecast(METHODS[name], PARAMS, state, state.time + ahead)
    for k, dt in enumerate(ahead):
        F = np.kron([[1.0, dt], [0.0, 1.0]], np.eye(2))
        Q = PARAMS["q"] * np.kron([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]], np.eye(2))
        agree(found.mean[k], F @ mean)
        grown = np.exp(dt / PARAMS["tau"]) if name == "ewif" else 1.0
        agree(found.cov[k], F @ cov @ F.T * grown + (0 if name == "ewif" else Q))


@pytest.mark.parametrize("name", ["al1", "replay"])
def test_forecasts_of_many_tracks_are_those_of_each(name):
    """From states that differ, at common times or their own, with parameters of their own."""
    est, params = METHODS[name], {**PARAMS, "q": np.linspace(0.1, 0.5, TRACKS)}
    flags = {**dict.fromkeys(PARAMS, False), "q": True}
    states = ej.run_batch(
        est, params, TRACKS_AT_ONCE, prior=PRIOR, t0=0.0, params_per_run=flags
    ).final_state
    own = np.asarray(states.time)[:, None] + np.array([0.0, 2.0])
    for times in (np.array([8.0, 7.0, 20.0]), own):
        found = ej.forecast(est, params, states, times, params_per_run=flags)
        assert found.mean.shape == (TRACKS, times.shape[-1], 4)
        for k in range(TRACKS):
            state, at = (
                jax.tree.map(lambda x, k=k: x[k], states),
                times[k] if times.ndim == 2 else times,
            )
            wanted = ej.forecast(est, {**params, "q": params["q"][k]}, state, at)
            agree(jax.tree.map(lambda x, k=k: x[k], found), wanted)
    with pytest.raises(ValueError, match="times: expected 5 runs"):
        ej.forecast(est, params, states, own[:3], params_per_run=flags)
    with pytest.raises(ValueError, match=r"params\['q'\]: expected 5 runs"):
        ej.forecast(est, {**params, "q": params["q"][:2]}, states, own, params_per_run=flags)


def test_a_forecast_refuses_what_is_no_time():
    state = METHODS["kalman"].init(PARAMS, PRIOR, 0.0)
    for times in (np.array(1.0), np.array([1.0, np.nan])):
        with pytest.raises(ValueError, match="times: expected"):
            ej.forecast(METHODS["kalman"], PARAMS, state, times)
    textbook = ej.kalman(ej.linear_model(np.eye(1), np.eye(1), np.eye(1), np.eye(1)))
    prior_of_one = ej.Gaussian(np.zeros(1), np.eye(1))
    state = textbook.init(None, prior_of_one, 0.0)
    with pytest.raises(ValueError, match=r"times: expected whole steps"):
        ej.forecast(textbook, None, state, np.array([1.0, 2.5]))
    tracks = jax.vmap(lambda t0: textbook.init(None, prior_of_one, t0))(np.array([0.0, 0.25]))
    both = np.array([[1.0, 3.0], [2.25, 1.25]])
    np.testing.assert_allclose(ej.forecast(textbook, None, tracks, both).cov[:, :, 0, 0] % 1, 0)
    with pytest.raises(ValueError, match=r"times: expected whole steps"):
        ej.forecast(textbook, None, tracks, np.array([1.0, 3.0]))


def test_tracks_of_a_discrete_model_count_their_own_steps():
    """At other phases and far apart; where nothing arrived, any time will do."""
    textbook = ej.kalman(ej.linear_model(np.eye(1), np.eye(1), np.eye(1), np.eye(1), max_steps=9))
    start = np.array([0.0, 500.25, 3.5])
    prior = ej.Gaussian(np.zeros(1), np.eye(1))
    states = jax.vmap(lambda t0: textbook.init(None, prior, t0))(start)
    mask = np.array([[True], [True], [False]])
    arrived = ej.Measurement(
        start + np.array([1.0, 2.0, 0.3]), np.ones((3, 1)), np.zeros(3, int), mask
    )
    kept, info = ej.step_batch(textbook, None, states, arrived)
    np.testing.assert_allclose(kept.mean[:, 0], [2 / 3, 3 / 4, 0.0])
    assert list(info.status) == [ej.Status.USED, ej.Status.USED, ej.Status.MASKED]
    with pytest.raises(ValueError, match=r"measurement\.time: expected whole steps"):
        ej.step_batch(textbook, None, states, arrived._replace(time=start + 0.5))
