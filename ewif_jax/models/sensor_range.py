"""Refusing a sensor the model does not have.

JAX clamps an index that is out of range and says nothing, so `table[sensor]` would quietly answer
for another sensor. Where the index is known now it is checked: against the number of sensors if the
model knows it, else by evaluating what the model sees with JAX's index checks.
"""

from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from jax.core import Tracer
from jax.experimental import checkify
from jax.extend.core import jaxpr_as_fun

from ewif_jax import checks


def check_sensor(count: int | None, see: Callable[..., Any], sensor: Any, *inputs: Any) -> None:
    """Refuses a known index outside 0..count-1, or one that `see(sensor, *inputs)` clamps."""
    index = checks.known(sensor)
    if index is None or index.ndim:
        return
    checks.sensor("measurement.sensor", int(index), count)
    if count is None and index > 0:
        example = jax.tree.map(_example, inputs)
        checks.require(
            not _clamps(see, int(index), example) or _clamps(see, 0, example),
            "measurement.sensor",
            "an index inside the tables that H and R (or observe and measurement_cov) look up",
            int(index),
        )


def _clamps(see: Callable[..., Any], index: int, inputs: tuple) -> bool:
    """Whether an index goes out of range in see(index, *inputs), computed now even inside a trace.

    The checks are traced on their own first: they see nothing when traced in eager evaluation.
    """
    checked = checkify.checkify(see, errors=checkify.index_checks)
    at = (np.int32(index), *inputs)
    jaxpr, shape = jax.make_jaxpr(lambda *args: checked(*args)[0], return_shape=True)(*at)
    with jax.ensure_compile_time_eval():
        error = jax.jit(jaxpr_as_fun(jaxpr))(*jax.tree.leaves(at))
    return jax.tree.unflatten(jax.tree.structure(shape), error).get() is not None


def _example(x: Any) -> Any:
    """`x` itself, or ones where its value is not known yet."""
    return np.ones(x.shape, x.dtype) if isinstance(x, Tracer) else x
