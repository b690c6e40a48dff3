"""Refusing a sensor the model does not have.

JAX clamps an index that is out of range and says nothing, so `table[sensor]` would quietly answer
for another sensor. Where the index is known now it is checked: against the number of sensors if the
model knows it, else by evaluating what the model sees with JAX's index checks.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.experimental import checkify
from jax.extend.core import jaxpr_as_fun

from ewif_jax import checks
from ewif_jax.fast.memo import question_of, remembered
from ewif_jax.models.components import check_components
from ewif_jax.models.model import Model
from ewif_jax.recipe import digest
from ewif_jax.types import Measurement, Numbers, Params


def check_sensor(model: Model, params: Params, x: Numbers, sensor: Numbers, t: Numbers) -> None:
    """Refuses a known index that the model has no sensor for, or that it clamps where it looks
    something up; a linear model does not need to know the state x."""
    index = checks.concrete_value(sensor)
    if index is None or index.ndim:
        return
    checks.sensor("measurement.sensor", int(index), model.sensors)
    if model.sensors is None and index > 0:
        checks.require(
            _inside_tables(model, int(index), (params, None if model.linear else x, t)),
            "measurement.sensor",
            "an index inside the tables that H and R (or observe and measurement_cov) look up",
            int(index),
        )


def check_sensors(model: Model, params: Params, x: Numbers, measurements: Measurement) -> None:
    """`check_sensor` of the largest known index of a whole stream, and what each of its rows says
    that its sensor does not have."""
    checks.sensors(measurements, model.sensors)
    check_components(model, measurements)
    indices = checks.concrete_value(measurements.sensor)
    if indices is not None and indices.size:
        time = jnp.asarray(measurements.time).ravel()[0]
        check_sensor(model, params, x, np.int32(indices.max()), time)


def _inside_tables(model: Model, index: int, inputs: tuple) -> bool:
    """Whether the model has what it looks up for this index, asked once: the answer depends on the
    sizes of tables, and on whole numbers that may be indices too."""
    functions = question_of(model.linear, model.observe, model.measurement_cov)
    leaves, tree = jax.tree.flatten(inputs)
    # Functions that are gone answer to no question, so they need not be kept.
    question = _inside_tables, functions, index, tree, *map(_size_or_index, leaves)

    def looks_inside() -> bool:
        examples = jax.tree.map(_example_value, inputs)
        return not _index_clamps(model, index, examples) or _index_clamps(model, 0, examples)

    return remembered(question, looks_inside)


def _size_or_index(x: Numbers) -> Any:
    aval = jax.typeof(x)
    integer = jnp.issubdtype(aval.dtype, jnp.integer) or aval.dtype == bool
    whole_numbers = checks.concrete_value(x) if integer else None
    return aval if whole_numbers is None else (aval, digest(whole_numbers))


def _index_clamps(model: Model, index: int, inputs: tuple) -> bool:
    """Whether an index goes out of range in what the model sees, computed now even inside a trace.

    The checks are traced on their own first: they see nothing when traced in eager evaluation.
    """
    linear = model.linear

    def seen(sensor: Numbers, params: Params, x: Numbers, t: Numbers) -> tuple[Any, Any]:
        R = model.measurement_cov(params, sensor, t)
        if linear is None:
            return model.observe(params, x, sensor, t), R
        return linear.H(params, sensor, t), R

    checked = checkify.checkify(seen, errors=checkify.index_checks)
    at = (np.int32(index), *inputs)
    jaxpr, shape = jax.make_jaxpr(lambda *args: checked(*args)[0], return_shape=True)(*at)
    with jax.ensure_compile_time_eval():
        error = jax.jit(jaxpr_as_fun(jaxpr))(*jax.tree.leaves(at))
    return jax.tree.unflatten(jax.tree.structure(shape), error).get() is not None


def _example_value(x: Numbers) -> Any:
    """`x` itself, or ones where its value is not known yet."""
    return np.ones(x.shape, x.dtype) if isinstance(x, Tracer) else x
