"""Every estimator of the registry keeps the contract of `ewif_jax.Estimator`.

Compiling is what takes the time, so each function of an estimator is compiled once and shared.
"""

from collections.abc import Callable, Collection
from functools import cache
from typing import Any, NamedTuple

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
    STEPS,
    T0,
    Row,
    small_model,
    standard_prior,
    standard_stream,
)
from ewif_jax import Estimator, Gaussian, Info, Measurement, Status, run, step

each = pytest.mark.parametrize("row", ROWS, ids=lambda row: row.name)
AS_IT_IS = ("kalman", "ewif", "pf_extended")
"""Whose hundreds of operations are also compiled one by one; the others' with --all."""
BOTH_MODES = ("kalman", "ewif", "replay")
"""Whose forward mode is compared with reverse mode; the others' with --all."""
OF_EACH_KIND = ("kalman", "ewif", "limited_memory", "al1", "replay", "gated", "imm", "ensemble",
                "pf_retrodict")  # fmt: skip
"""Whose `run` a user's own vmap is tried on; the others' with --all: `run_batch` is in any case."""
WRAPPED = ("information", "drop_late", "gated", "selective")
"""Whose gradients are those of what they wrap, or of kalman by a law; here with --all."""
NONLINEAR = ("extended", "unscented", "ensemble", "ensemble_square_root", "enkf1", "enkf2_shared",
             "rts_reference", "al1", "asd")  # fmt: skip
"""Whose gradients test_ensemble_filters_survive_and_differentiate compares; here with --all."""


def some(names: Collection[str]) -> Any:
    """These rows; the others with --all."""
    rows = [pytest.param(row, marks=() if row.name in names else pytest.mark.slow) for row in ROWS]
    return pytest.mark.parametrize("row", rows, ids=lambda row: row.name)


both_dtypes = pytest.mark.parametrize("dtype", [np.float32, np.float64])
CLOSE = {"rtol": 1e-9, "atol": 1e-11}
FLOATS = {name: np.asarray(value) for name, value in PARAMS.items()}


class Built(NamedTuple):
    """An estimator, its jitted functions, and the dtypes for which `step` was traced."""

    estimator: Estimator
    init: Callable[..., Any]
    step: Callable[..., Any]
    predict: Callable[..., Any]
    estimate: Callable[..., Any]
    traces: list[Any]


@cache
def built(row: Row) -> Built:
    estimator = row.build(small_model())
    traces = []

    def counted(params: Any, state: Any, z: Measurement) -> Any:
        traces.append(z.value.dtype)
        return step(estimator, params, state, z)

    functions = (estimator.init, counted, estimator.predict, estimator.estimate)
    return Built(estimator, *(jax.jit(f) for f in functions), traces)


def key_of(row: Row) -> Any:
    return jax.random.key(0) if row.needs_key else None


def first_state(row: Row, dtype: Any = np.float64, known: bool = True) -> Any:
    """The state at T0 with the standard prior, or knowing nothing."""
    prior = Gaussian(*(jnp.asarray(x, dtype) for x in standard_prior())) if known else None
    return built(row).init(PARAMS, prior, jnp.asarray(T0, dtype), key_of(row))


def arrival(k: int, dtype: Any = np.float64) -> Measurement:
    return jax.tree.map(lambda x: x[k], standard_stream(dtype))


class Streamed(NamedTuple):
    states: list[Any]
    infos: list[Info]
    estimates: list[Gaussian]


@cache
def streamed(row: Row, dtype: Any = np.float64, known: bool = True) -> Streamed:
    """The standard stream, one `step` at a time; states[k] is the state before arrival k."""
    state = first_state(row, dtype, known)
    states, infos, estimates = [state], [], []
    for k in range(STEPS):
        state, info = built(row).step(PARAMS, state, arrival(k, dtype))
        states.append(state)
        infos.append(info)
        estimates.append(built(row).estimate(PARAMS, state))
    return Streamed(states, infos, estimates)


def traced(row: Row, params: Any = PARAMS, value: Any = None, known: bool = True) -> Any:
    """`run` on the standard stream, with other values if given."""
    stream = standard_stream()
    stream = stream if value is None else stream._replace(value=value)
    prior = standard_prior() if known else None
    return run(built(row).estimator, params, stream, prior=prior, t0=T0, key=key_of(row))


def avals(tree: Any) -> Any:
    return jax.tree.map(lambda x: (jnp.shape(x), x.dtype, getattr(x, "weak_type", False)), tree)


def float_dtypes(tree: Any) -> set[Any]:
    return {x.dtype for x in jax.tree.leaves(tree) if jnp.issubdtype(x.dtype, jnp.floating)}


def numbers(x: Any) -> np.ndarray:
    """`x`, with a PRNG key as its numbers."""
    is_key = jnp.issubdtype(x.dtype, jax.dtypes.prng_key)
    return np.asarray(jax.random.key_data(x) if is_key else x)


def same(actual: Any, expected: Any, rtol: float = 0.0, atol: float = 0.0) -> None:
    assert jax.tree.structure(actual) == jax.tree.structure(expected)
    for a, e in zip(jax.tree.leaves(actual), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(numbers(a), numbers(e), rtol=rtol, atol=atol)


def identical(a: Any, b: Any) -> bool:
    pairs = zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    return all(np.array_equal(numbers(x), numbers(y), equal_nan=True) for x, y in pairs)


@each
@both_dtypes
def test_init_and_step_have_the_same_avals_so_a_jitted_step_traces_once(row, dtype):
    states = streamed(row, dtype).states
    assert all(avals(state) == avals(states[0]) for state in states)
    assert built(row).traces.count(np.dtype(dtype)) == 1


@each
def test_init_from_plain_numbers_has_the_same_avals(row):
    prior = Gaussian(*(np.asarray(x) for x in standard_prior()))
    plain = built(row).estimator.init(PARAMS, prior, T0, key_of(row))
    assert avals(plain) == avals(first_state(row))


@each
@both_dtypes
def test_the_dtype_of_the_input_is_the_dtype_of_everything(row, dtype):
    assert float_dtypes(streamed(row, dtype)) == {np.dtype(dtype)}


@each
def test_float32_is_close_to_float64(row):
    if row.needs_key:
        pytest.skip("draws other random numbers")
    single, double = streamed(row, np.float32), streamed(row)
    for k in range(STEPS):
        mean, cov = double.estimates[k]
        error = (single.estimates[k].mean - mean) / np.sqrt(np.diag(cov))
        assert np.abs(error).max() < 1e-4
        np.testing.assert_allclose(single.estimates[k].cov, cov, rtol=1e-4, atol=1e-5)
        expected = double.infos[k].log_likelihood
        np.testing.assert_allclose(single.infos[k].log_likelihood, expected, rtol=1e-4, atol=1e-4)


@some(AS_IT_IS)
def test_jit_is_eager(row):
    state, z = streamed(row).states[6], arrival(6)
    eager = step(built(row).estimator, PARAMS, state, z)
    same(eager, (streamed(row).states[7], streamed(row).infos[6]), **CLOSE)


@each
def test_streaming_is_the_scan(row):
    trace, stream = traced(row), streamed(row)
    same(stream.states[-1], trace.final_state, **CLOSE)
    for k in range(STEPS):
        same(stream.infos[k], jax.tree.map(lambda x, k=k: x[k], trace.info), **CLOSE)
        if k != PADDING:  # there the scan reports a prediction
            same(stream.estimates[k], Gaussian(trace.mean[k], trace.cov[k]), **CLOSE)


@some(OF_EACH_KIND)
def test_vmap_is_the_loop(row):
    values = standard_stream().value[None] + jnp.arange(3.0)[:, None, None]
    params = {**PARAMS, "r": jnp.asarray([0.2, 0.5, 1.0])}
    axes = ({name: 0 if name == "r" else None for name in PARAMS}, 0)

    def shown(params: Any, value: Any) -> Any:
        trace = traced(row, params, value)
        return trace.mean, trace.cov, trace.info

    batch = jax.vmap(shown, in_axes=axes)(params, values)
    for k in range(3):
        alone = shown({**PARAMS, "r": float(params["r"][k])}, values[k])
        same(jax.tree.map(lambda x, k=k: x[k], batch), alone, **CLOSE)


def loss_of(row: Row) -> Callable[[Any], jax.Array]:
    """With masked and late measurements, and from nothing where that is possible."""
    if not row.differentiable:
        pytest.skip("resampling is not differentiable")
    built(row)  # its constants must not belong to a trace of the loss

    def loss(params: Any) -> jax.Array:
        trace = traced(row, params, known=not row.accepts_no_prior)
        errors = jnp.sum(trace.mean[2:] ** 2) + jnp.sum(trace.cov[2:, 0])
        return errors + 0.1 * jnp.sum(trace.info.log_likelihood)

    return loss


@cache
def gradient(row: Row) -> Any:
    return jax.jit(jax.grad(loss_of(row)))(FLOATS)


@some({row.name for row in ROWS}.difference(NONLINEAR, WRAPPED))
def test_gradient_is_finite_and_the_finite_difference(row):
    loss, slope, h = loss_of(row), gradient(row), 1e-5
    for name, value in PARAMS.items():
        up, down = (loss({**PARAMS, name: value + shift}) for shift in (h, -h))
        expected = float(up - down) / (2 * h)
        np.testing.assert_allclose(slope[name], expected, rtol=1e-5, atol=1e-6, err_msg=name)


@some(BOTH_MODES)
def test_forward_mode_is_reverse_mode(row):
    loss = loss_of(row)
    forward = jax.jit(lambda params: jax.jvp(loss, (params,), (params,))[1])(FLOATS)
    along = sum(gradient(row)[name] * PARAMS[name] for name in PARAMS)
    np.testing.assert_allclose(forward, along, rtol=1e-8, atol=1e-10)


@each
def test_padding_is_a_no_op(row):
    state = streamed(row).states[5]
    nothing = Measurement(
        jnp.asarray(LAST, float),  # with a dtype: not another program for weak types
        jnp.full(2, jnp.nan, float),
        jnp.asarray(1, jnp.int32),
        jnp.zeros(2, bool),
    )
    padded, info = built(row).step(PARAMS, state, nothing)
    assert identical(padded, state)
    assert info.status == Status.MASKED
    assert info.log_likelihood == 0
    np.testing.assert_array_equal(info.innovation, 0)


@each
@pytest.mark.parametrize("bad", [np.nan, np.inf, 1e200])
@pytest.mark.parametrize("age", [-0.2, 0.0, 0.4, 7.0])
def test_what_is_not_a_number_is_rejected_and_changes_nothing(row, bad, age):
    """In one component; 1e200 is a number, its square is not."""
    state = streamed(row).states[6]
    value = arrival(6).value.at[1].set(bad)
    z = arrival(6)._replace(time=state.time - age, value=value)
    after, info = built(row).step(PARAMS, state, z)
    assert info.status == Status.REJECTED
    assert identical(after, state)
    assert info.log_likelihood == 0
    assert all(np.isfinite(x).all() for x in info)
    absent = z._replace(mask=jnp.asarray([True, False]))
    _, info = built(row).step(PARAMS, state, absent)
    assert info.status != Status.REJECTED
    assert all(np.isfinite(x).all() for x in info)


@each
@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_a_time_that_is_not_a_number_is_rejected(row, bad):
    state = streamed(row).states[6]
    after, info = built(row).step(PARAMS, state, arrival(6)._replace(time=jnp.asarray(bad, float)))
    assert info.status == Status.REJECTED
    assert identical(after, state)
    assert all(np.isfinite(x).all() for x in info)


@each
def test_delay_zero_is_in_sequence(row):
    state, z = streamed(row).states[5], arrival(5)
    moved = built(row).predict(PARAMS, state, z.time)
    one, info = built(row).step(PARAMS, moved, z)
    assert info.status == streamed(row).infos[5].status == Status.USED
    assert info.delay == 0
    if not row.needs_key:
        same((one, info), (streamed(row).states[6], streamed(row).infos[5]), **CLOSE)


@each
@pytest.mark.parametrize("age", [0.4, 7.0])
def test_a_late_measurement_is_used_or_changes_nothing(row, age):
    """7 s is before t0 and beyond any lag, window or maximal delay of the registry."""
    state = streamed(row).states[6]
    updated, info = built(row).step(PARAMS, state, arrival(6)._replace(time=state.time - age))
    used = row.late == Status.LATE_USED and (age < 1 or row.any_age)
    assert info.status == (Status.LATE_USED if used else Status.TOO_LATE)
    np.testing.assert_allclose(info.delay, age, rtol=1e-12)
    assert identical(updated, state) == (not used)
    assert (info.log_likelihood != 0) == used


@each
def test_covariances_are_symmetric_and_positive(row):
    cov = np.stack([estimate.cov for estimate in streamed(row).estimates])
    np.testing.assert_array_equal(cov, cov.swapaxes(1, 2))
    assert np.linalg.eigvalsh(cov).min() > 0


@each
def test_info_has_the_shapes_and_statuses_it_documents(row):
    info = jax.tree.map(lambda *leaves: np.stack(leaves), *streamed(row).infos)
    assert info.innovation.shape == (STEPS, 2)
    assert info.innovation_cov.shape == (STEPS, 2, 2)
    assert info.log_likelihood.shape == info.delay.shape == info.status.shape == (STEPS,)
    assert info.status.dtype == np.int32
    expected = np.full(STEPS, Status.USED)
    expected[PADDING] = Status.MASKED
    expected[list(LATE)] = row.late
    np.testing.assert_array_equal(info.status, expected)
    np.testing.assert_allclose(info.delay[list(LATE)], [0.4, 0.3], rtol=1e-9)
    np.testing.assert_array_equal(info.innovation[~np.asarray(standard_stream().mask)], 0)
    used = np.isin(info.status, (Status.USED, Status.LATE_USED))
    np.testing.assert_array_equal(info.log_likelihood != 0, used)
    assert np.linalg.eigvalsh(info.innovation_cov).min() > 0


@each
def test_a_missing_prior_is_refused_or_means_that_nothing_is_known(row):
    if not row.accepts_no_prior:
        name = row.refuses or row.name
        with pytest.raises(ValueError, match=f"prior: expected a Gaussian: {name} .*got None"):
            first_state(row, known=False)
        return
    assert avals(first_state(row, known=False)) == avals(first_state(row))
    one_component, _ = built(row).step(PARAMS, first_state(row, known=False), arrival(1))
    blind = built(row).estimate(PARAMS, one_component)
    assert np.isnan(blind.mean).all()
    assert np.isnan(blind.cov).all()
    assert all(np.isfinite(mean).all() for mean, _ in streamed(row, known=False).estimates[2:])


@each
def test_a_missing_key_is_refused(row):
    if not row.needs_key:
        pytest.skip("draws nothing")
    with pytest.raises(ValueError, match="key: expected a PRNG key"):
        built(row).estimator.init(PARAMS, standard_prior(), T0)


@each
def test_an_earlier_time_is_predicted_or_nan(row):
    state = streamed(row).states[5]

    def shown(time: Any) -> Gaussian:
        return built(row).estimate(PARAMS, built(row).predict(PARAMS, state, time))

    earlier = shown(state.time - 0.5)
    good = np.isfinite if row.predicts_back else np.isnan
    assert good(earlier.mean).all()
    assert good(earlier.cov).all()
    same(shown(state.time), built(row).estimate(PARAMS, state), **CLOSE)


@each
def test_a_sensor_the_model_does_not_have_is_refused(row):
    stream = standard_stream()
    stream = stream._replace(sensor=stream.sensor.at[5].set(2))
    with pytest.raises(ValueError, match=r"sensor: expected an index below 2 .*got 2"):
        run(built(row).estimator, PARAMS, stream, prior=standard_prior(), t0=T0, key=key_of(row))
