"""Worlds to test filters in."""

from ewif_jax.scenarios.arbitrary_target import (
    arbitrary_noise,
    arbitrary_path,
    arbitrary_target,
    arbitrary_target_model,
)
from ewif_jax.scenarios.arrowhead import (
    arrowhead,
    arrowhead_ekf,
    arrowhead_ekf_model,
    arrowhead_model,
    arrowhead_path,
    arrowhead_state,
)
from ewif_jax.scenarios.divergence import divergence, divergence_curve, divergence_filter
from ewif_jax.scenarios.mixed_fleet import mixed_fleet, mixed_fleet_model
from ewif_jax.scenarios.random_walk import random_walk, random_walk_model
from ewif_jax.scenarios.sine import sine, sine_model, sine_signal
from ewif_jax.scenarios.three_clocks import three_clocks, three_clocks_model
from ewif_jax.scenarios.turn import turn, turn_model, turn_state
from ewif_jax.scenarios.two_bearings import two_bearings, two_bearings_model, two_bearings_path

__all__ = [
    "arbitrary_noise",
    "arbitrary_path",
    "arbitrary_target",
    "arbitrary_target_model",
    "arrowhead",
    "arrowhead_ekf",
    "arrowhead_ekf_model",
    "arrowhead_model",
    "arrowhead_path",
    "arrowhead_state",
    "divergence",
    "divergence_curve",
    "divergence_filter",
    "mixed_fleet",
    "mixed_fleet_model",
    "random_walk",
    "random_walk_model",
    "sine",
    "sine_model",
    "sine_signal",
    "three_clocks",
    "three_clocks_model",
    "turn",
    "turn_model",
    "turn_state",
    "two_bearings",
    "two_bearings_model",
    "two_bearings_path",
]
