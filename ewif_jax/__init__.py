"""Differentiable filtering with late measurements in JAX.

A model of the world (`linear_model`, `models`), an estimator (`ewif`, `kalman`, ...), and a stream
of measurements in arrival order go into `run`; `monte_carlo` and `tune` build on it.
"""

from ewif_jax import models, scenarios
from ewif_jax.analysis.consistency import chi2_band, nees, nis, rmse
from ewif_jax.analysis.equivalence import (
    Case,
    equivalent_process_noise,
    equivalent_tau,
    steady_gain,
)
from ewif_jax.analysis.expected import expected_mse
from ewif_jax.batch import run_batch
from ewif_jax.estimator import run, step, stream
from ewif_jax.estimators.ewif import ewif
from ewif_jax.estimators.extended import extended
from ewif_jax.estimators.fading import fading
from ewif_jax.estimators.information import information
from ewif_jax.estimators.kalman import kalman
from ewif_jax.estimators.limited_memory import limited_memory
from ewif_jax.estimators.square_root import square_root
from ewif_jax.models import Model, linear_model
from ewif_jax.monte_carlo import (
    Scenario,
    Simulation,
    Statistics,
    monte_carlo,
    simulate_batch,
)
from ewif_jax.smoothers.batch_wls import batch_wls
from ewif_jax.smoothers.savgol import savgol
from ewif_jax.tuning import (
    Transform,
    Tuned,
    likelihood_loss,
    nees_loss,
    nis_loss,
    positive,
    prediction_loss,
    psd,
    rmse_loss,
    tune,
    unconstrained,
)
from ewif_jax.types import Estimator, Gaussian, Info, Measurement, Status, Trace

__all__ = [
    "Case",
    "Estimator",
    "Gaussian",
    "Info",
    "Measurement",
    "Model",
    "Scenario",
    "Simulation",
    "Statistics",
    "Status",
    "Trace",
    "Transform",
    "Tuned",
    "batch_wls",
    "chi2_band",
    "equivalent_process_noise",
    "equivalent_tau",
    "ewif",
    "expected_mse",
    "extended",
    "fading",
    "information",
    "kalman",
    "likelihood_loss",
    "limited_memory",
    "linear_model",
    "models",
    "monte_carlo",
    "nees",
    "nees_loss",
    "nis",
    "nis_loss",
    "positive",
    "prediction_loss",
    "psd",
    "rmse",
    "rmse_loss",
    "run",
    "run_batch",
    "savgol",
    "scenarios",
    "simulate_batch",
    "square_root",
    "steady_gain",
    "step",
    "stream",
    "tune",
    "unconstrained",
]
