"""Several sensors as one: a measurement's index chooses. Sensors may say different numbers of
things: what a sensor lacks beside the widest is absent, and never counts."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from ewif_jax import checks
from ewif_jax.fast.compiling import array
from ewif_jax.fast.sparse import Pattern, pattern
from ewif_jax.models.parameters import resolve
from ewif_jax.models.sensors import Sensor, wrap_angle
from ewif_jax.models.tables import different, select, wider, wider_cov
from ewif_jax.types import Numbers, Parameter, Params


class Bank(NamedTuple):
    """What a model asks of its sensors, of which `sensor` is the index. All values are as wide as
    the widest sensor's; beyond its own, a sensor sees 0 with unit noise and H = 0.

    observe: (params, x, sensor, t) -> (m,)
    cov: (params, sensor, t) -> (m, m)
    residual: (value, predicted, sensor) -> (m,); wraps angles
    matrix: if all are linear, matrix(n) -> H(params, sensor, t), and where any H differs from zero
    offset: (params, sensor, t) -> (m,) of z = H x + offset, or None
    count: of sensors
    sizes: how many components each has, or None where all have as many
    latency: (S,) seconds by which the stamps of each are late, or a function of params; or None
    """

    observe: Callable[..., Array]
    cov: Callable[..., Array]
    residual: Callable[..., Array]
    matrix: Callable[[int], tuple[Callable[..., Array], Pattern]] | None
    offset: Callable[..., Array] | None
    count: int
    sizes: tuple[int, ...] | None
    latency: Parameter


def bank(sensors: Sensor | Sequence[Sensor]) -> Bank:
    """Sensors chosen by their index."""
    group = (sensors,) if isinstance(sensors, Sensor) else tuple(sensors)
    checks.require(len(group) > 0, "sensors", "at least one sensor", "none")
    for k, one in enumerate(group):
        is_sensor = isinstance(one, Sensor)
        checks.require(is_sensor, f"sensors[{k}]", "a Sensor", f"a {type(one).__name__}")
    sizes = tuple(len(s.angle) for s in group)
    m = max(sizes)
    angles = np.stack([wider(np.asarray(s.angle), m) for s in group])

    def observe(params: Params, x: Array, sensor: Array, t: Array) -> Array:
        return _chosen([wider(s.observe(params, x, t), m) for s in group], sensor)

    def cov(params: Params, sensor: Array, t: Array) -> Array:
        return _chosen([wider_cov(s.cov(params, t), m) for s in group], sensor)

    def residual(value: Array, predicted: Array, sensor: Array) -> Array:
        difference = value - predicted
        if not angles.any():
            return difference
        wrapped = wrap_angle(difference)
        if angles.all():
            return wrapped
        return jnp.where(jnp.asarray(angles)[sensor], wrapped, difference)

    def offset(params: Params, sensor: Array, t: Array) -> Array:
        made = [None if s.offset is None else s.offset(params, t) for s in group]
        dtype = jnp.result_type(*(x for x in made if x is not None))
        full = [jnp.zeros(m, dtype) if x is None else wider(x, m).astype(dtype) for x in made]
        return _chosen(full, sensor)

    def matrix(n: int) -> tuple[Callable[..., Array], Pattern]:
        matrices = [wider(s.matrix(n), m) for s in group if s.matrix is not None]
        table = [array(H) for H in matrices]
        return (lambda params, sensor, t: _chosen(table, sensor)), pattern(*matrices)

    is_linear = all(s.matrix is not None for s in group)
    shifted = is_linear and any(s.offset is not None for s in group)
    return Bank(
        observe,
        cov,
        residual,
        matrix if is_linear else None,
        offset if shifted else None,
        len(group),
        different(sizes),
        _latency_of(group),
    )


def _latency_of(group: Sequence[Sensor]) -> Parameter:
    latencies = [s.latency for s in group]
    if not any(map(callable, latencies)):
        constants = np.asarray(latencies, float)
        return constants if constants.any() else None

    def latency(params: Params) -> Array:
        return jnp.stack([jnp.asarray(resolve(x, params)) for x in latencies])

    return latency


def _chosen(values: list[Any], index: Numbers) -> Any:
    if len(values) == 1:
        return values[0]
    is_concrete = not isinstance(index, Array) and not any(isinstance(x, Array) for x in values)
    if not is_concrete:
        return select(jnp.stack(values), index)
    return np.stack(values)[np.minimum(index, len(values) - 1)]  # refused elsewhere, by name
