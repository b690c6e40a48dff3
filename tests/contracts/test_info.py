"""`Info` means the same for every estimator, whatever a row was not used for."""

from functools import cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from contracts.registry import (
    PADDING,
    PARAMS,
    ROWS,
    STEPS,
    T0,
    Row,
    standard_prior,
    standard_stream,
)
from contracts.test_contract import built, first_state, identical, key_of, same
from ewif_jax import Info, Measurement, Status, run, run_batch

each = pytest.mark.parametrize("row", ROWS, ids=lambda row: row.name)
BEFORE_T0 = 6
LATE_AND_MASKED = 9
NOT_A_NUMBER = (4, 7, 8, 10)
TOO_LARGE = {np.float32: 1e20, np.float64: 1e200}
"""Numbers whose squares are not."""
MOVES_ANEW = ("information", "drop_late")
"""Whose equations are made triangular again by a move over no time, which rounds them."""
CLOSE = {"rtol": 1e-9, "atol": 1e-11}


def unused_stream(dtype: Any = np.float64) -> Measurement:
    """The standard stream with rows that nothing can use: masked ones (with values that are not
    numbers), one from before t0, and values and a time that are not numbers."""
    time, value, sensor, mask = (np.array(x) for x in standard_stream(dtype))
    time[BEFORE_T0] = T0 - 5.0
    mask[LATE_AND_MASKED] = False
    value[[PADDING, LATE_AND_MASKED]] = np.nan
    mask[list(NOT_A_NUMBER)] = True
    value[4, 1], value[7, 0], value[8, 1] = np.nan, -np.inf, TOO_LARGE[dtype]
    time[10] = np.nan
    return Measurement(*(jnp.asarray(x) for x in (time, value, sensor, mask)))


class Stepped(NamedTuple):
    """states[k] is the state before arrival k; info leads with arrivals."""

    states: list[Any]
    info: Info


@cache
def stepped(row: Row, dtype: Any = np.float64) -> Stepped:
    states, infos = [first_state(row, dtype)], []
    stream = unused_stream(dtype)
    for k in range(STEPS):
        measurement = jax.tree.map(lambda x, k=k: x[k], stream)
        state, info = built(row).step(PARAMS, states[-1], measurement)
        states.append(state)
        infos.append(info)
    return Stepped(states, jax.tree.map(lambda *rows: np.stack(rows), *infos))


def expected_statuses(row: Row) -> dict[int, Status]:
    """Of the rows that are not used. Some filters use data of any age."""
    statuses = dict.fromkeys((PADDING, LATE_AND_MASKED), Status.MASKED)
    statuses |= dict.fromkeys(NOT_A_NUMBER, Status.REJECTED)
    return statuses if row.any_age else {**statuses, BEFORE_T0: Status.TOO_LATE}


@each
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_what_is_not_used_says_so_alike(row, dtype):
    states, info = stepped(row, dtype)
    times = np.asarray(unused_stream(dtype).time)
    for k, status in expected_statuses(row).items():
        assert info.status[k] == status, k
        np.testing.assert_array_equal(info.innovation[k], 0)
        np.testing.assert_array_equal(info.innovation_cov[k], np.eye(2))
        assert info.log_likelihood[k] == 0
        ahead = max(states[k].time, times[k]) if np.isfinite(times[k]) else np.nan
        delay = ahead - times[k] if np.isfinite(times[k]) else 0
        assert info.delay[k] == np.asarray(delay, dtype), k
        if k == BEFORE_T0 and row.name in MOVES_ANEW:
            same(states[k + 1], states[k], *2 * [8 * np.finfo(dtype).eps])
        else:
            assert identical(states[k + 1], states[k]), k


@each
def test_run_and_run_batch_say_what_step_says(row):
    """One run with rows that are not used beside one of which all are; traced, because what is
    known not to be a number is refused before."""
    estimator, key = built(row).estimator, key_of(row)
    start = {"prior": standard_prior(), "t0": T0}
    keys = None if key is None else jnp.stack([key, key])

    @jax.jit
    def filtered(alone: Measurement, both: Measurement) -> Any:
        together = run_batch(estimator, PARAMS, both, key=keys, **start)
        trace = run(estimator, PARAMS, alone, key=key, **start)
        return trace.info, jax.tree.map(lambda x: x[0], together.info), trace.final_state

    unused, used = unused_stream(), standard_stream()
    *infos, state = filtered(unused, jax.tree.map(lambda *x: jnp.stack(x), unused, used))
    expected = stepped(row)
    for info in infos:
        np.testing.assert_array_equal(info.status, expected.info.status)
        same(info, expected.info, **CLOSE)
    same(state, expected.states[-1], **CLOSE)
