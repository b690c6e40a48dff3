"""What every entry asks of a model before it traces anything: times it can count, and parameters
that make covariances."""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import numpy as np

from ewif_jax import checks
from ewif_jax.models.domain import check_covariances
from ewif_jax.models.model import Model
from ewif_jax.models.steps import check_steps
from ewif_jax.types import DTypeLike, Measurement, Numbers, Params


def check_times(
    model: Model | None,
    measurements: Measurement,
    t0: Numbers,
    dtype: DTypeLike,
    times: Numbers = None,
    in_order: bool = True,
) -> None:
    """Refuses known times of measurements (..., T) and of reports that lie between two steps of a
    discrete model; t0 None: counted from the first measurement. `in_order` False: they are used in
    the order of their times."""
    if model is None or model.steps is None:
        return
    stamps = checks.concrete_value(measurements.time)
    if stamps is not None:
        stamps = stamps if in_order else np.sort(stamps, -1)
        check_steps(model.steps, stamps, t0, dtype)
    if times is None:
        return
    if t0 is None:
        first = checks.concrete_value(measurements.time)
        t0 = None if first is None else first.ravel()[0]
    if t0 is not None:
        check_steps(model.steps, times, t0, dtype, "times", in_order=False)


def check_span(model: Model, sources: Any, times: Numbers) -> None:
    """Refuses known times (K,) to which something known of `sources` (arrays of times, or None)
    would have to be moved over too many steps at once."""
    if model.steps is None:
        return
    concrete = [checks.concrete_value(x) for x in (*(s for s in sources if s is not None), times)]
    stamps = [x.astype(float).ravel() for x in concrete if x is not None]
    if len(stamps) < len(concrete) or len(concrete) < 2:
        return
    moved = np.concatenate(stamps[:-1])
    far = max(stamps[-1].max() - moved.min(), moved.max() - stamps[-1].min())
    most = model.steps.max_steps
    checks.require(
        round(far / model.steps.dt) <= most,
        "times",
        f"at most max_steps = {most} steps of dt = {model.steps.dt:g} s to every measurement and "
        "the prior (give linear_model a larger max_steps=)",
        f"{far:.10g} s",
    )


def without_process_noise(model: Model) -> Model:
    """The model for a method that never asks for Q: parameters of Q may be missing."""
    check = model.check or check_covariances(None, model.measurement_cov)
    return model._replace(check=partial(_of_measurements, check))


def _of_measurements(
    check: Callable[..., None], params: Params, t0: Numbers, t1: Numbers, sensors: Numbers
) -> None:
    del t0
    check(params, t1, t1, sensors)


def check_covariances_of(
    model: Model | None, params: Params, t0: Numbers, times: Numbers, sensors: Numbers
) -> None:
    """Refuses known parameters that make a Q or R of the model that is no covariance.

    Looked at are the interval from t0 to the last of `times`, or one step, and these sensors.
    """
    given = (params, t0, times, sensors)
    if model is None or any(checks.concrete_value(x) is None for x in jax.tree.leaves(given)):
        return
    check = model.check or check_covariances(model.process_cov, model.measurement_cov)
    # NumPy asks an array of JAX for its maximum, which inside a trace is not computed now.
    start, end = (float(np.max(np.asarray(t))) for t in (t0, times))
    if model.steps is not None:
        end = start + model.steps.dt
    elif not end > start:
        end = start + 1.0  # no interval would say nothing of Q
    seen = np.unique(np.asarray(sensors)).astype(np.int32)
    with jax.ensure_compile_time_eval():
        check(params, np.asarray(start), np.asarray(end), seen)
