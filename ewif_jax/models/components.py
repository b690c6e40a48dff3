"""Which components of a value a sensor has, where sensors say different numbers of things."""

import jax.numpy as jnp
import numpy as np
from jax import Array

from ewif_jax import checks
from ewif_jax.models.model import Model
from ewif_jax.types import Measurement


def check_components(
    model: Model | None, measurements: Measurement, argument: str = "measurements"
) -> None:
    """Refuses known rows (..., m) in which something is present that their sensor does not have."""
    if model is None or model.sizes is None:
        return
    sensor, mask = map(checks.concrete_value, (measurements.sensor, measurements.mask))
    if sensor is None or mask is None or mask.shape[-1] != max(model.sizes):
        return  # a wrong width is refused by those who see the value
    beyond = mask & ~_exists(model.sizes, sensor, mask.shape[-1])
    if not beyond.any():
        return
    place = [int(i) for i in np.argwhere(beyond)[0]]
    index = int(np.broadcast_to(sensor[..., None], beyond.shape)[tuple(place)])
    row = f" at row {place[-2]}" if len(place) > 1 else ""
    run = f" of run {place[-3]}" if len(place) > 2 else ""
    size = model.sizes[index]
    checks.require(
        False,
        f"{argument}.mask",
        f"nothing present beyond the {size} component{'s' * (size != 1)} of sensor {index} (NaN in "
        "the value given to `stream`, or mask False)",
        f"component {place[-1]}{row}{run}",
    )


def existing(model: Model | None, measurements: Measurement) -> Measurement:
    """The measurements (..., m) without what their sensors do not have."""
    if model is None or model.sizes is None:
        return measurements
    mask = jnp.asarray(measurements.mask)
    has = _exists(model.sizes, measurements.sensor, mask.shape[-1])
    return measurements._replace(mask=mask & has)


def _exists(sizes: tuple[int, ...], sensor: Array | np.ndarray, m: int) -> Array | np.ndarray:
    """(..., m): whether each sensor has each component."""
    if isinstance(sensor, Array):
        # A sum and no gather, which is slow in a batch.
        own = sum(jnp.where(sensor == k, size, 0) for k, size in enumerate(sizes))
        return jnp.stack([own > component for component in range(m)], -1)
    own = np.asarray(sizes)[np.minimum(sensor, len(sizes) - 1)]  # refused elsewhere, by name
    return np.arange(m) < own[..., None]
