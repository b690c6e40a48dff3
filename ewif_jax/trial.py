"""What is checked before a stream is filtered, and the trial of one arrival."""

from collections.abc import Hashable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from ewif_jax import checks
from ewif_jax.arrival import arrive, initial
from ewif_jax.fast.compiling import array
from ewif_jax.fast.memo import question_of, remembered
from ewif_jax.recipe import digest
from ewif_jax.streams import cast, float_dtype
from ewif_jax.types import Estimator, Gaussian, Measurement


def validated(
    estimator: Estimator,
    params: Any,
    measurements: Measurement,
    prior: Gaussian | None,
    t0: Any,
    times: Any,
    clock: str,
    key: Any,
) -> Any:
    """The shapes of the estimator's state, after everything else than the stream that can be known
    now has been checked."""
    checks.prior(prior)
    checks.shape("t0", t0, ())
    checks.finite("t0", t0)
    checks.require(clock in ("validity", "arrival"), "clock", "'validity' or 'arrival'", clock)
    needs_times = clock == "arrival" and times is None
    checks.require(not needs_times, "times", "arrival times, since clock='arrival'", None)
    dtype = float_dtype(measurements.value)
    checks.resolvable(measurements.time, dtype)
    if times is not None:
        checks.report_times(times, np.shape(measurements.time)[0])
    sensors = checks.known(measurements.sensor)
    last = None if sensors is None else np.int32(sensors.max())

    def first() -> Any:
        given = jax.tree.map(_indexable, params)
        state = initial(estimator, given, prior, t0, dtype, key)
        if not last and not jax.tree.leaves(params):
            return state  # nothing is known that the program itself would not refuse
        one = jax.tree.map(lambda x: jnp.asarray(x)[0], cast(measurements, dtype))
        if last is not None:  # a known index is checked where the model is asked about it
            one = one._replace(sensor=last)
        return arrive(estimator, given, state, one, None if times is None else times[0]).kept

    # Trying takes longer than filtering a short stream, so equal trials are made once.
    x64 = bool(jax.config.jax_enable_x64)  # pyright: ignore
    setting = np.shape(measurements.value), times is None, clock, dtype, key is None, x64
    question = _question(estimator, setting, (params, prior, t0, last))
    return remembered(question, lambda: jax.eval_shape(first))


def _question(estimator: Estimator, setting: Hashable, values: Any) -> Hashable | None:
    """What tells this trial from others; None while something is being traced."""
    filtered = question_of(estimator)
    leaves, structure = jax.tree.flatten(values)
    if filtered is None or any(isinstance(x, Tracer) for x in leaves):
        return None
    known = map(np.asarray, leaves)
    return filtered, setting, structure, *((x.shape, x.dtype, digest(x)) for x in known)


def _indexable(x: Any) -> Any:
    """`x`, its value known as before; but a NumPy table cannot be indexed while tracing."""
    with jax.ensure_compile_time_eval():
        return array(x) if isinstance(x, np.ndarray) else x
