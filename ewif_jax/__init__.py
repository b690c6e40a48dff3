"""Differentiable filtering with late measurements in JAX.

A model of the world (`linear_model`, `models`), an estimator (`ewif`, `kalman`, ...), and a stream
of measurements in arrival order go into `run`; `monte_carlo` and `tune` build on it.
"""

from ewif_jax import models, scenarios, scores
from ewif_jax.analysis.consistency import chi2_band, nees, nis, rmse
from ewif_jax.analysis.equivalence import Case, equivalent_process_noise, equivalent_tau
from ewif_jax.analysis.expected import expected_mse
from ewif_jax.analysis.merit import (
    alpha_beta_eigenvalues,
    alpha_beta_gains,
    cutoff_delay,
    delayed_gain,
    gain_history,
    maneuvering_index,
    random_walk_cutoff,
    random_walk_gain,
    steady_state_gain,
)
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
from ewif_jax.oosm.a1 import a1
from ewif_jax.oosm.al1 import al1
from ewif_jax.oosm.asd import asd
from ewif_jax.oosm.b1 import b1
from ewif_jax.oosm.bl1 import bl1
from ewif_jax.oosm.drop_late import drop_late
from ewif_jax.oosm.replay import replay
from ewif_jax.oosm.selective import selective
from ewif_jax.parallel import run_parallel
from ewif_jax.smoothers.batch_wls import batch_wls
from ewif_jax.smoothers.fixed_lag import fixed_lag, fixed_lag_ewif
from ewif_jax.smoothers.rts import rts
from ewif_jax.smoothers.savgol import savgol
from ewif_jax.smoothers.two_sided_ewif import two_sided_ewif
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
    "a1",
    "al1",
    "alpha_beta_eigenvalues",
    "alpha_beta_gains",
    "asd",
    "b1",
    "batch_wls",
    "bl1",
    "chi2_band",
    "cutoff_delay",
    "delayed_gain",
    "drop_late",
    "equivalent_process_noise",
    "equivalent_tau",
    "ewif",
    "expected_mse",
    "extended",
    "fading",
    "fixed_lag",
    "fixed_lag_ewif",
    "gain_history",
    "information",
    "kalman",
    "likelihood_loss",
    "limited_memory",
    "linear_model",
    "maneuvering_index",
    "models",
    "monte_carlo",
    "nees",
    "nees_loss",
    "nis",
    "nis_loss",
    "positive",
    "prediction_loss",
    "psd",
    "random_walk_cutoff",
    "random_walk_gain",
    "replay",
    "rmse",
    "rmse_loss",
    "rts",
    "run",
    "run_batch",
    "run_parallel",
    "savgol",
    "scenarios",
    "scores",
    "selective",
    "simulate_batch",
    "square_root",
    "steady_state_gain",
    "step",
    "stream",
    "tune",
    "two_sided_ewif",
    "unconstrained",
]
