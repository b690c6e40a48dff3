"""What is checked before a stream is filtered, and the trial of one arrival."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ewif_jax import checks, clocks
from ewif_jax.arrival import arrive, initial
from ewif_jax.checks import Shown
from ewif_jax.fast.compiling import array
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
    """The shapes of the estimator's state, after everything that can be known now of what
    `streams.given` returned has been checked."""
    checks.prior(prior)
    checks.require(t0 is not None, "t0", "the time of the prior in seconds", None)
    checks.require(clock in ("validity", "arrival"), "clock", "'validity' or 'arrival'", clock)
    needs_times = clock == "arrival" and times is None
    checks.require(not needs_times, "times", "arrival times, since clock='arrival'", None)
    checks.random_key(key)
    dtype = float_dtype(measurements.value)
    if times is not None:
        checks.report_times(times, np.shape(measurements.time)[0])
    if clock == "arrival":
        clocks.not_ahead(dtype, measurements.time, measurements.mask, times, t0)
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
        to = None if times is None else jnp.asarray(times, dtype)[0]
        kept = arrive(estimator, given, state, one, to).kept
        _require_same_shapes(state, kept)
        return kept

    shapes = np.shape(measurements.value), times is None, clock
    trial = _fingerprint((estimator, shapes, dtype, key is None), (params, prior, t0, last))
    if trial is None:
        return jax.eval_shape(first)
    if trial not in _tried:
        if len(_tried) >= 1000:
            _tried.clear()
        _tried[trial] = jax.eval_shape(first)
    return _tried[trial]


def _require_same_shapes(before: Any, after: Any) -> None:
    """Refuses what a step leaves in other shapes: a parameter that is an array where a number was
    meant."""
    old, new = (jax.tree.map(jnp.shape, x) for x in (before, after))
    same = jax.tree.structure(before) == jax.tree.structure(after) and old == new
    expected = f"values with which a step keeps the shapes of the state, {old}"
    checks.require(same, "params", expected, Shown(new))


def _indexable(x: Any) -> Any:
    """`x`, its value known as before; but a NumPy table cannot be indexed while tracing."""
    with jax.ensure_compile_time_eval():
        return array(x) if isinstance(x, np.ndarray) else x


_tried: dict[Any, Any] = {}
"""What has gone through one trial arrival, and the shapes of the state that came out: trying takes
longer than filtering a short stream."""


def _fingerprint(structure: Any, values: Any) -> Any:
    """Equal for equal trials; None while something in `values` is not known."""
    leaves, tree = jax.tree.flatten(values)
    known = [x for x in map(checks.known, leaves) if x is not None]
    if len(known) < len(leaves):
        return None
    return structure, tree, tuple((x.shape, x.dtype.str, x.tobytes()) for x in known)
