"""Counting the steps of a discrete-time model between two times, and refusing what is between."""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from ewif_jax import checks
from ewif_jax.types import DTypeLike, Numbers, Steps

SHARE = 0.01
"""How far from a whole step a stamp may be, in steps."""
ROUNDINGS = 4
"""How far it may be in roundings of the times: each of two stamps and their difference have one."""


def count_steps(steps: Steps, t0: Numbers, t1: Numbers) -> tuple[Any, Any]:
    """The steps from t0 to t1 (int32, negative against time; 0 where they are not whole), and
    whether they are whole."""
    dtype = jnp.result_type(t0, t1)
    dtype = dtype if jnp.issubdtype(dtype, jnp.floating) else jnp.result_type(float)
    # In NumPy where it can be: JAX would compile each of these operations by itself.
    is_concrete = checks.concrete_value(t0) is not None and checks.concrete_value(t1) is not None
    xp = np if is_concrete else jnp
    start, end = (
        np.asarray(t).astype(dtype) if is_concrete else lax.stop_gradient(jnp.asarray(t, dtype))
        for t in (t0, t1)
    )
    interval = end - start
    number = xp.round(interval / steps.dt)
    rounding = ROUNDINGS * jnp.finfo(dtype).eps * xp.maximum(abs(start), abs(end))
    # Stamps that are each as near to a grid as they may be differ by twice as much.
    near = xp.maximum(2 * SHARE * steps.dt, rounding)
    whole = (
        (abs(interval - number * steps.dt) <= near)
        & (abs(number) <= steps.max_steps)
        & (rounding <= steps.dt / 4)
    )
    return xp.where(whole, number, 0).astype(jnp.int32), whole


def whole_steps(steps: Steps, t0: Numbers, t1: Numbers) -> Array:
    """Whether the model can be asked to go from t0 to t1."""
    return count_steps(steps, t0, t1)[1]


def check_steps(
    steps: Steps | None,
    times: Numbers,
    t0: Numbers,
    dtype: DTypeLike,
    argument: str = "measurements.time",
    in_order: bool = True,
) -> None:
    """Refuses known times (..., T) that are not whole steps from t0 (None: from the first).

    Args:
        steps: the model's; None lets everything pass.
        times: as they were given, before they are rounded to the filter's dtype.
        t0: where the counting starts, so that the rounding of many intervals does not add up.
        dtype: in which the filter will count.
        argument: its name.
        in_order: whether a filter goes from each to the next, and so takes `max_steps` at once.
    """
    given = checks.concrete_value(times)
    start = None if t0 is None else checks.concrete_value(t0)
    if steps is None or given is None or (start is None and t0 is not None) or not given.size:
        return
    stamps = np.atleast_1d(given).astype(float)
    first = stamps[..., :1] if start is None else np.asarray(start, float)
    larger = np.maximum(abs(stamps), abs(first))
    rounding = ROUNDINGS * float(jnp.finfo(dtype).eps) * larger
    lost = rounding > steps.dt / 4
    _refuse_where(
        lost,
        f"{argument}: expected times at which {jnp.dtype(dtype).name} can count steps of "
        f"dt = {steps.dt:g} s, got {_bad_stamp(stamps, lost)}: subtract the first time, or use "
        "float64",
    )
    number = np.round((stamps - first) / steps.dt)
    between = abs(stamps - first - number * steps.dt) > np.maximum(SHARE * steps.dt, rounding)
    _refuse_where(
        between,
        f"{argument}: expected whole steps of dt = {steps.dt:g} s from {_as_text(first)} on, since "
        f"constants in linear_model are a model in discrete time, got {_bad_stamp(stamps, between)}"
        f"{_gap_text(stamps, between)}. Give linear_model the step of its constants as dt=, or "
        "functions of (params, t0, t1): models.from_continuous makes them",
    )
    if in_order:
        before = np.concatenate([np.zeros_like(number[..., :1]), number[..., :-1]], -1)
        far = abs(number - np.maximum.accumulate(before, -1)) > steps.max_steps
        _refuse_where(
            far,
            f"{argument}: expected at most max_steps = {steps.max_steps} steps of dt = "
            f"{steps.dt:g} s at once, got {_bad_stamp(stamps, far)}{_gap_text(stamps, far)}. Give "
            "linear_model a larger max_steps=",
        )


def check_interval(steps: Steps | None, argument: str, interval: Numbers) -> None:
    """Refuses a known interval () that is not whole steps of a discrete model."""
    seconds = checks.concrete_value(interval)
    if steps is None or seconds is None:
        return
    checks.require(
        count_steps(steps, np.zeros(()), seconds.astype(float))[1],
        argument,
        f"whole steps of dt = {steps.dt:g} s, at most max_steps = {steps.max_steps} of them, since "
        "constants in linear_model are a model in discrete time (give linear_model the step of its "
        "constants as dt=)",
        float(seconds),
    )


def _refuse_where(bad: np.ndarray, message: str) -> None:
    if bad.any():
        raise ValueError(message)


def _bad_stamp(stamps: np.ndarray, bad: np.ndarray) -> str:
    """The first bad stamp and its row."""
    if not bad.any():
        return ""
    place = int(np.flatnonzero(bad)[0])
    number, row = divmod(place, np.shape(stamps)[stamps.ndim - 1])
    run = f" of run {number}" if stamps.ndim > 1 else ""
    return f"{stamps.ravel()[place]:.10g} at row {row}{run}"


def _gap_text(stamps: np.ndarray, bad: np.ndarray) -> str:
    """The interval before the first bad stamp, and the usual one."""
    if not bad.any() or np.shape(stamps)[stamps.ndim - 1] < 2:
        return ""
    width = stamps.shape[stamps.ndim - 1]
    run, row = divmod(int(np.flatnonzero(bad)[0]), width)
    series = stamps.reshape(-1, width)[run]
    usual = float(np.median(np.diff(np.unique(series)).astype(float))) if np.ptp(series) else 0.0
    last = "" if not row else f"{series[row] - series[row - 1]:.6g} s after the row before, "
    return f" ({last}the median interval is {usual:.6g} s)"


def _as_text(first: np.ndarray) -> str:
    return f"t0 = {float(first):.10g}" if first.ndim == 0 else "the first time"
