"""Filters in continuous time, whose measurements are a signal."""

from ewif_jax.analysis.anderson_continuous import (
    ContinuousSystem,
    steady_state_continuous,
    weighting_as_input_noise,
)
from ewif_jax.continuous.error import actual_error_continuous, error_bounds_continuous
from ewif_jax.continuous.kalman_bucy import Signal, kalman_bucy

__all__ = [
    "ContinuousSystem",
    "Signal",
    "actual_error_continuous",
    "error_bounds_continuous",
    "kalman_bucy",
    "steady_state_continuous",
    "weighting_as_input_noise",
]
