"""The physical world, written once for all filters: how a state moves and what a sensor sees."""

from ewif_jax.models.continuous_time import from_continuous
from ewif_jax.models.coordinated_turn import coordinated_turn
from ewif_jax.models.kinematic import (
    constant_acceleration,
    constant_velocity,
    random_walk,
)
from ewif_jax.models.linearise import (
    affine_flow,
    observation,
    predict_measurement,
    predict_state,
    size,
)
from ewif_jax.models.model import Linear, Model, linear_model
from ewif_jax.models.parameters import resolve
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
    "from_continuous",
    "linear_model",
    "observation",
    "position_sensor",
    "predict_measurement",
    "predict_state",
    "random_walk",
    "resolve",
    "size",
    "wrap_angle",
]
