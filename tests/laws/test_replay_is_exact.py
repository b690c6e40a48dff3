"""Replay is the wrapped estimator on the stream sorted by validity time, whatever it wraps."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from late_streams import problem, stream

import ewif_jax as ej
from ewif_jax.oosm.replay import replay


class NoisyState(NamedTuple):
    time: jax.Array
    inner: Any
    key: jax.Array


def noisy(estimator):
    """An estimator that draws a random number in every prediction, of any length."""

    def init(params, prior, t0, key=None):
        inner = estimator.init(params, prior, t0)
        return NoisyState(inner.time, inner, key)

    def predict(params, state, time):
        inner = estimator.predict(params, state.inner, time)
        key, now = jax.random.split(state.key)
        shift = 0.1 * jax.random.normal(now, inner.mean.shape, inner.mean.dtype)
        return NoisyState(inner.time, inner._replace(mean=inner.mean + shift), key)

    def update(params, state, measurement):
        inner, info = estimator.update(params, state.inner, measurement)
        return state._replace(inner=inner), info

    def estimate(params, state):
        return estimator.estimate(params, state.inner)

    return ej.Estimator(init, predict, update, estimate)


GIVEN = problem(1, 3, 2)


@pytest.mark.parametrize(
    "estimator",
    [
        ej.kalman(GIVEN.model),
        ej.square_root(GIVEN.model),
        ej.information(GIVEN.model),
        ej.extended(GIVEN.model._replace(linear=None)),
        ej.ewif(GIVEN.model, tau=1.5),
        ej.fading(GIVEN.model, 1.1),
        noisy(ej.kalman(GIVEN.model)),
    ],
    ids=["kalman", "square_root", "information", "extended", "ewif", "fading", "noisy"],
)
def test_replay_is_the_sorted_run(estimator):
    rng = np.random.default_rng(2)
    times = np.sort(rng.uniform(0.0, 4.0, 12))
    data = stream(GIVEN, rng, times)
    arrival = np.argsort(times + rng.exponential(0.7, 12))
    late = jax.tree.map(lambda x: x[arrival], data)
    options = {"prior": GIVEN.prior, "t0": 0.0, "key": jax.random.key(3)}
    replayed = ej.run(replay(estimator, 8), None, late, **options)
    sorted_run = jax.jit(lambda data: ej.run(estimator, None, data, **options).final_state)
    for k in (4, 7, 11):
        seen = np.isin(np.arange(12), arrival[: k + 1])
        state = sorted_run(data._replace(mask=data.mask & seen[:, None]))
        expected = estimator.estimate(None, state)
        np.testing.assert_allclose(replayed.mean[k], expected.mean, atol=1e-12)
        np.testing.assert_allclose(replayed.cov[k], expected.cov, atol=1e-12)


def test_older_than_the_buffer_is_too_late():
    rng = np.random.default_rng(4)
    data = stream(GIVEN, rng, np.array([1.0, 2.0, 3.0, 4.0, 1.9, 2.5, -0.5]))
    trace = ej.run(replay(ej.kalman(GIVEN.model), 2), None, data, prior=GIVEN.prior, t0=0.0)
    used, late, too_late = ej.Status.USED, ej.Status.LATE_USED, ej.Status.TOO_LATE
    expected = [used, used, used, used, too_late, late, too_late]
    np.testing.assert_array_equal(trace.info.status, expected)
    np.testing.assert_array_equal(trace.mean[4], trace.mean[3])
    np.testing.assert_array_equal(trace.mean[6], trace.mean[5])
    assert trace.info.log_likelihood[4] == 0


def test_replay_needs_room_for_the_measurement():
    given = problem(1, 2, 2)
    data = stream(given, np.random.default_rng(0), np.ones(1))
    narrow = replay(ej.kalman(given.model), 2, width=1)
    with pytest.raises(ValueError, match="width: expected room for 2 components, got 1"):
        ej.run(narrow, None, data, prior=given.prior, t0=0.0)
    with pytest.raises(ValueError, match="lag"):
        replay(ej.kalman(GIVEN.model), 0)
    with pytest.raises(ValueError, match="estimator: expected an Estimator"):
        replay(GIVEN.model, 3)


def test_replay_with_masked_components():
    rng = np.random.default_rng(8)
    times = np.array([1.0, 2.0, 1.5, 3.0, 0.5])
    data = stream(GIVEN, rng, times)
    mask = jnp.array([[True, True], [True, False], [False, True], [False, False], [True, True]])
    data = data._replace(mask=mask)
    trace = ej.run(replay(ej.kalman(GIVEN.model), 5), None, data, prior=GIVEN.prior, t0=0.0)
    seen = jax.tree.map(lambda x: x[np.array([4, 0, 2, 1])], data)
    expected = ej.run(ej.kalman(GIVEN.model), None, seen, prior=GIVEN.prior, t0=0.0)
    np.testing.assert_allclose(
        trace.final_state.current.mean, expected.final_state.mean, atol=1e-12
    )
    assert trace.info.status[3] == ej.Status.MASKED
