"""The physical world, written once for all filters: how a state moves and what a sensor sees."""

from ewif_jax.models.coordinated_turn import coordinated_turn
from ewif_jax.models.kinematic import (
    constant_acceleration,
    constant_velocity,
    random_walk,
)
from ewif_jax.models.model import (
    Linear,
    Model,
    affine_flow,
    flow,
    linear_model,
    observation,
    patterns,
    resolve,
    sight,
    size,
)
from ewif_jax.models.sensors import Sensor, bearing_sensor, position_sensor, wrap_angle

__all__ = [
    "Linear",
    "Model",
    "Sensor",
    "affine_flow",
    "bearing_sensor",
    "constant_acceleration",
    "constant_velocity",
    "coordinated_turn",
    "flow",
    "linear_model",
    "observation",
    "patterns",
    "position_sensor",
    "random_walk",
    "resolve",
    "sight",
    "size",
    "wrap_angle",
]
