"""Every estimator of the registry keeps the contract of `ewif_jax.Estimator`."""

from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from contracts.registry import (
    LAST,
    LATE,
    PADDING,
    PARAMS,
    ROWS,
    T0,
    Row,
    small_model,
    standard_prior,
    standard_stream,
)
from ewif_jax import Estimator, Gaussian, Measurement, Status, run, step

each = pytest.mark.parametrize("row", ROWS, ids=lambda row: row.name)


@cache
def built(row: Row) -> tuple[Estimator, Any]:
    """The estimator and its jitted step: shared by all claims, compiled once."""
    estimator = row.build(small_model())
    return estimator, jax.jit(lambda params, state, z: step(estimator, params, state, z))


def key_of(row: Row) -> Any:
    return jax.random.key(0) if row.needs_key else None


def first_state(row: Row, dtype: Any = np.float64) -> Any:
    prior = Gaussian(*(jnp.asarray(x, dtype) for x in standard_prior()))
    return built(row)[0].init(PARAMS, prior, jnp.asarray(T0, dtype), key_of(row))


def traced(row: Row, dtype: Any = np.float64, params: Any = None, **options: Any) -> Any:
    prior = options.pop("prior", standard_prior())
    stream = options.pop("stream", None)
    stream = standard_stream(dtype) if stream is None else stream
    params = PARAMS if params is None else params
    return run(
        built(row)[0], params, stream, prior=prior, t0=T0, key=key_of(row), **options
    )


def arrival(k: int, stream: Measurement | None = None) -> Measurement:
    return jax.tree.map(lambda x: x[k], standard_stream() if stream is None else stream)


def after(row: Row, count: int) -> Any:
    """The state after the first `count` arrivals."""
    state = first_state(row)
    for k in range(count):
        state, _ = built(row)[1](PARAMS, state, arrival(k))
    return state


def avals(tree: Any) -> Any:
    return jax.tree.map(lambda x: (jnp.shape(x), x.dtype, x.weak_type), tree)


def numbers(x: Any) -> Any:
    """`x`, with a PRNG key as its numbers."""
    is_key = jnp.issubdtype(x.dtype, jax.dtypes.prng_key)
    return np.asarray(jax.random.key_data(x) if is_key else x)


def same(actual: Any, expected: Any, **tolerance: float) -> None:
    assert jax.tree.structure(actual) == jax.tree.structure(expected)
    for a, e in zip(jax.tree.leaves(actual), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(numbers(a), numbers(e), **{"rtol": 0.0, **tolerance})


def without_key(row: Row, state: Any) -> Any:
    return state._replace(key=None) if row.needs_key else state


@each
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_init_and_step_have_the_same_avals_so_a_jitted_step_traces_once(row, dtype):
    estimator, traces = built(row)[0], []

    @jax.jit
    def counted(params: Any, state: Any, z: Measurement) -> Any:
        traces.append(1)
        return step(estimator, params, state, z)

    state = first_state(row, dtype)
    expected = avals(state)
    for k in range(12):
        state, _ = counted(PARAMS, state, arrival(k, standard_stream(dtype)))
        assert avals(state) == expected
    assert len(traces) == 1
    assert {x.dtype for x in jax.tree.leaves(state) if jnp.issubdtype(x.dtype, jnp.floating)} == {
        np.dtype(dtype)
    }


@each
def test_init_from_plain_numbers_has_the_avals_of_init_from_arrays(row):
    estimator = built(row)[0]
    prior = Gaussian(*(np.asarray(x) for x in standard_prior()))
    plain = estimator.init(PARAMS, prior, T0, key_of(row))
    assert avals(plain) == avals(first_state(row))


@each
def test_jit_is_eager(row):
    estimator, jitted = built(row)
    state = after(row, 6)
    same(step(estimator, PARAMS, state, arrival(6)), jitted(PARAMS, state, arrival(6)), rtol=1e-9,
         atol=1e-12)


@each
def test_streaming_is_the_scan(row):
    estimator, jitted = built(row)
    show = jax.jit(estimator.estimate)
    trace = traced(row)
    state = first_state(row)
    for k in range(12):
        state, info = jitted(PARAMS, state, arrival(k))
        same(info, jax.tree.map(lambda x, k=k: x[k], trace.info), rtol=1e-9, atol=1e-12)
        if k != PADDING:
            same(show(PARAMS, state), Gaussian(trace.mean[k], trace.cov[k]), rtol=1e-9, atol=1e-12)
    same(state, trace.final_state, rtol=1e-9, atol=1e-12)


@each
def test_vmap_is_the_loop(row):
    stream = standard_stream()
    values = stream.value[None] + jnp.arange(3.0)[:, None, None]
    params = {**PARAMS, "r": jnp.asarray([0.2, 0.5, 1.0])}
    axes = ({name: 0 if name == "r" else None for name in PARAMS}, 0)

    def means(params: Any, value: jax.Array) -> Any:
        trace = traced(row, params=params, stream=stream._replace(value=value))
        return trace.mean, trace.cov, trace.info

    batch = jax.vmap(means, in_axes=axes)(params, values)
    for k in range(3):
        alone = means({**PARAMS, "r": float(params["r"][k])}, values[k])
        same(jax.tree.map(lambda x, k=k: x[k], batch), alone, rtol=1e-9, atol=1e-11)


@each
def test_gradient_is_finite_and_the_finite_difference(row):
    if not row.differentiable:
        pytest.skip("resampling is not differentiable")
    prior = None if row.accepts_no_prior else standard_prior()

    def loss(params: Any) -> jax.Array:
        trace = traced(row, params=params, prior=prior)
        errors = jnp.sum(trace.mean[2:] ** 2) + jnp.sum(trace.cov[2:, 0])
        return errors + 0.1 * jnp.sum(trace.info.log_likelihood)

    def central(direction: Any, h: float = 1e-5) -> float:
        up, down = (
            loss({name: PARAMS[name] + s * h * direction[name] for name in PARAMS}) for s in (1, -1)
        )
        return float(up - down) / (2 * h)

    def both_modes(params: Any) -> Any:
        return jax.grad(loss)(params), jax.jvp(loss, (params,), (params,))[1]

    params = {name: jnp.asarray(value) for name, value in PARAMS.items()}
    reverse, forward = jax.jit(both_modes)(params)
    for name in PARAMS:
        expected = central({other: float(other == name) for other in PARAMS})
        np.testing.assert_allclose(reverse[name], expected, rtol=1e-6, atol=1e-7, err_msg=name)
    along = sum(reverse[name] * PARAMS[name] for name in PARAMS)
    np.testing.assert_allclose(forward, along, rtol=1e-9, atol=1e-10)


@each
def test_padding_is_a_no_op(row):
    state = after(row, 5)
    nothing = Measurement(
        jnp.asarray(LAST), jnp.full(2, jnp.nan), jnp.asarray(1, jnp.int32), jnp.zeros(2, bool)
    )
    padded, info = built(row)[1](PARAMS, state, nothing)
    same(padded, state)
    assert info.status == Status.MASKED
    assert info.log_likelihood == 0
    np.testing.assert_array_equal(info.innovation, 0)


@each
def test_padding_changes_nothing_of_what_follows(row):
    stream = standard_stream()
    kept = np.delete(np.arange(12), PADDING)
    short = jax.tree.map(lambda x: x[kept], stream)
    if row.needs_key:
        pytest.skip("its random numbers are counted by arrivals")
    with_padding, without = traced(row), traced(row, stream=short)
    same(with_padding.final_state, without.final_state, rtol=1e-12, atol=1e-13)
    same(with_padding.mean[kept], without.mean, rtol=1e-12, atol=1e-13)


@each
def test_delay_zero_is_in_sequence(row):
    estimator, jitted = built(row)
    state, z = after(row, 5), arrival(5)
    moved = jax.jit(estimator.predict)(PARAMS, state, z.time)
    one, info = jitted(PARAMS, moved, z)
    other, other_info = jitted(PARAMS, state, z)
    assert info.status == other_info.status == Status.USED
    assert info.delay == 0
    if not row.needs_key:
        same((one, info), (other, other_info), rtol=1e-9, atol=1e-12)


@each
@pytest.mark.parametrize("age", [0.4, 7.0])
def test_a_late_measurement_is_used_or_changes_nothing(row, age):
    """7 s is before t0 and beyond any lag, window or maximal delay of the registry."""
    state = after(row, 6)
    late = arrival(6)._replace(time=state.time - age)
    updated, info = built(row)[1](PARAMS, state, late)
    used = row.late == Status.LATE_USED and (age < 1 or row.any_age)
    assert info.status == (Status.LATE_USED if used else Status.TOO_LATE)
    np.testing.assert_allclose(info.delay, age, rtol=1e-12)
    changed = any(
        not np.array_equal(numbers(a), numbers(b))
        for a, b in zip(jax.tree.leaves(updated), jax.tree.leaves(state), strict=True)
    )
    assert changed == used
    assert (info.log_likelihood != 0) == used


@each
def test_covariances_are_symmetric_and_positive(row):
    cov = np.asarray(traced(row).cov)
    np.testing.assert_array_equal(cov, cov.swapaxes(1, 2))
    assert np.linalg.eigvalsh(cov).min() >= -1e-12


@each
def test_float32_in_is_float32_out_and_close_to_float64(row):
    single, double = traced(row, np.float32), traced(row)
    floats = [x for x in jax.tree.leaves(single) if jnp.issubdtype(x.dtype, jnp.floating)]
    assert {x.dtype for x in floats} == {np.dtype(np.float32)}
    if row.needs_key:
        return
    sd = np.sqrt(np.diagonal(np.asarray(double.cov), axis1=1, axis2=2))
    assert np.max(np.abs(single.mean - double.mean) / sd) < 1e-5
    np.testing.assert_allclose(single.cov, double.cov, rtol=2e-5, atol=1e-6)
    np.testing.assert_allclose(
        single.info.log_likelihood, double.info.log_likelihood, rtol=1e-5, atol=1e-5
    )


@each
def test_info_has_the_shapes_and_statuses_it_documents(row):
    info = traced(row).info
    assert info.innovation.shape == (12, 2)
    assert info.innovation_cov.shape == (12, 2, 2)
    assert info.log_likelihood.shape == info.delay.shape == info.status.shape == (12,)
    assert info.status.dtype == np.int32
    expected = np.full(12, Status.USED)
    expected[PADDING] = Status.MASKED
    expected[list(LATE)] = row.late
    np.testing.assert_array_equal(info.status, expected)
    np.testing.assert_allclose(np.asarray(info.delay)[list(LATE)], [0.4, 0.3], rtol=1e-9)
    present = np.asarray(standard_stream().mask)
    np.testing.assert_array_equal(np.asarray(info.innovation)[~present], 0)
    used = np.isin(np.asarray(info.status), (Status.USED, Status.LATE_USED))
    assert np.all(np.asarray(info.log_likelihood)[~used] == 0)
    assert np.all(np.asarray(info.log_likelihood)[used] != 0)
    assert np.linalg.eigvalsh(np.asarray(info.innovation_cov)).min() > 0


@each
def test_a_missing_prior_is_refused_or_means_nothing_is_known(row):
    if not row.accepts_no_prior:
        with pytest.raises(ValueError, match=rf"prior: expected a Gaussian: {row.refuses or row.name} .*None"):
            traced(row, prior=None)
        return
    trace = traced(row, prior=None)
    assert np.all(np.isfinite(trace.mean[2:]))
    assert np.all(np.isfinite(trace.cov[2:]))
    one_component = jax.tree.map(lambda x: x[1:2], standard_stream())
    blind = run(built(row)[0], PARAMS, one_component, prior=None, t0=T0, key=key_of(row))
    assert np.all(np.isnan(blind.mean))
    assert np.all(np.isnan(blind.cov))


@each
def test_a_missing_key_is_refused(row):
    if not row.needs_key:
        pytest.skip("draws nothing")
    with pytest.raises(ValueError, match="key: expected a PRNG key"):
        run(built(row)[0], PARAMS, standard_stream(), prior=standard_prior(), t0=T0)


@each
def test_a_time_before_its_own_is_predicted_or_nan(row):
    estimator = built(row)[0]
    state = after(row, 5)
    back = jax.jit(lambda s, t: estimator.estimate(PARAMS, estimator.predict(PARAMS, s, t)))
    earlier = back(state, state.time - 0.5)
    assert bool(np.all(np.isfinite(earlier.mean))) == row.predicts_back
    assert bool(np.all(np.isnan(earlier.mean))) == (not row.predicts_back)
    assert np.all(np.isfinite(back(state, state.time).mean))


@each
def test_reporting_never_moves_the_filter(row):
    times = np.linspace(1.0, LAST, 12)
    np.testing.assert_array_equal(traced(row, times=times).time, times)
    same(traced(row, times=times).final_state, traced(row).final_state, rtol=1e-12, atol=1e-13)


@each
def test_a_sensor_the_model_does_not_have_is_refused(row):
    stream = standard_stream()
    with pytest.raises(ValueError, match=r"sensor: expected an index below 2 .*got 2"):
        traced(row, stream=stream._replace(sensor=stream.sensor.at[5].set(2)))
