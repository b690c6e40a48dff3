"""The physical world, written once for all filters: how a state moves and what a sensor sees."""

from ewif_jax.models.continuous_time import from_continuous
from ewif_jax.models.coordinated_turn import coordinated_turn
from ewif_jax.models.imperfect import biased, jittered
from ewif_jax.models.inputs import Inputs
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
from ewif_jax.models.ranging import (
    azimuth_elevation_range_sensor,
    bearing_sensor,
    range_bearing_rate_sensor,
    range_bearing_sensor,
    range_rate_sensor,
    range_sensor,
)
from ewif_jax.models.sensors import Sensor, position_sensor, sensor, velocity_sensor, wrap_angle

__all__ = [
    "Inputs",
    "Linear",
    "Model",
    "Sensor",
    "affine_flow",
    "azimuth_elevation_range_sensor",
    "bearing_sensor",
    "biased",
    "constant_acceleration",
    "constant_velocity",
    "coordinated_turn",
    "from_continuous",
    "jittered",
    "linear_model",
    "observation",
    "position_sensor",
    "predict_measurement",
    "predict_state",
    "random_walk",
    "range_bearing_rate_sensor",
    "range_bearing_sensor",
    "range_rate_sensor",
    "range_sensor",
    "resolve",
    "sensor",
    "size",
    "velocity_sensor",
    "wrap_angle",
]
