"""Differentiable filtering with late measurements in JAX."""
from ewif_jax import models
from ewif_jax.estimator import run, step, stream
from ewif_jax.estimators.ewif import ewif
from ewif_jax.estimators.extended import extended
from ewif_jax.estimators.fading import fading
from ewif_jax.estimators.information import information
from ewif_jax.estimators.kalman import kalman
from ewif_jax.estimators.square_root import square_root
from ewif_jax.models import Model, linear_model
from ewif_jax.types import Estimator, Gaussian, Info, Measurement, Status, Trace
