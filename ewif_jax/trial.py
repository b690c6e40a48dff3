"""What is checked before a stream is filtered, and the trial of one arrival."""

from collections.abc import Hashable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.tree_util import keystr, tree_leaves_with_path

from ewif_jax import checks, clocks
from ewif_jax.arrival import arrive, initial
from ewif_jax.checks import Shown
from ewif_jax.fast.compiling import array
from ewif_jax.fast.memo import question_of, remembered
from ewif_jax.models.entry import check_covariances_of, check_times
from ewif_jax.models.wide_prior import check_prior_width, first_rows
from ewif_jax.recipe import digest
from ewif_jax.streams import cast, float_dtype
from ewif_jax.types import Estimator, Gaussian, Measurement, Numbers, Params, PyTree, RandomKey


def validated(
    estimator: Estimator,
    params: Params,
    measurements: Measurement,
    prior: Gaussian | None,
    t0: Numbers,
    times: Numbers,
    clock: str,
    key: RandomKey,
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
    check_times(estimator.model, measurements, t0, dtype, times)
    if clock == "arrival":
        clocks.not_ahead(dtype, measurements.time, measurements.mask, times, t0)
    sensors = checks.concrete_value(measurements.sensor)
    last = None if sensors is None else np.int32(sensors.max())

    def first() -> Any:
        given = jax.tree.map(_as_indexable, params)
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

    # Trying takes longer than filtering a short stream, so equal trials are made once.
    x64 = bool(jax.config.jax_enable_x64)  # pyright: ignore
    setting = np.shape(measurements.value), times is None, clock, dtype, key is None, x64
    question = _trial_question(estimator, setting, (params, prior, t0, last))

    def tried() -> Any:
        model, stamps = estimator.model, measurements.time
        check_covariances_of(model, params, t0, stamps, measurements.sensor)
        try:
            return jax.eval_shape(first)
        except TypeError as error:  # JAX names the two shapes, but nothing that a caller gave
            _name_parameters(params, error)
            raise

    state = remembered(question, tried)
    # A factor or information holds any prior: only what keeps a covariance is asked.
    rows = first_rows(measurements, prior, t0)
    model = estimator.model
    if (
        prior is not None
        and rows is not None
        and model is not None
        and hasattr(getattr(state, "current", state), "cov")
    ):
        asked = _trial_question(estimator, setting, (params, prior, t0, rows))
        if asked is not None:  # else something is traced
            remembered(asked, lambda: check_prior_width(model, params, prior, t0, rows, dtype))
    return state


def _require_same_shapes(before: PyTree, after: PyTree) -> None:
    """Refuses what a step leaves in other shapes: a parameter that is an array where a number was
    meant."""
    old, new = (jax.tree.map(jnp.shape, x) for x in (before, after))
    same = jax.tree.structure(before) == jax.tree.structure(after) and old == new
    expected = f"values with which a step keeps the shapes of the state, {old}"
    checks.require(same, "params", expected, Shown(new))


def _name_parameters(params: Params, error: TypeError) -> None:
    """Raises in place of `error` of shapes, if some parameter is an array."""
    shapes = {keystr(path): np.shape(x) for path, x in tree_leaves_with_path(params)}
    arrays = [f"{name} {shape}" for name, shape in shapes.items() if shape]
    if arrays and "shape" in str(error):
        raise ValueError(
            "params: expected values of the shapes that model and filter compute with, got "
            f"{', '.join(arrays)}: {error}"
        ) from error


def _trial_question(estimator: Estimator, setting: Hashable, values: PyTree) -> Hashable | None:
    """What tells this trial from others; None while something is being traced."""
    filtered = question_of(estimator)
    leaves, structure = jax.tree.flatten(values)
    if filtered is None or any(isinstance(x, Tracer) for x in leaves):
        return None
    arrays = map(np.asarray, leaves)
    return filtered, setting, structure, *((x.shape, x.dtype, digest(x)) for x in arrays)


def _as_indexable(x: Numbers) -> Any:
    """`x`, its value known as before; but a NumPy table cannot be indexed while tracing."""
    with jax.ensure_compile_time_eval():
        return array(x) if isinstance(x, np.ndarray) else x
