"""Differentiable filtering with late measurements in JAX.

A model of the world (`linear_model`, `models`), an estimator (`ewif`, `kalman`, ...), and a stream
of measurements in arrival order go into `run`; `monte_carlo` and `tune` build on it.
"""

from ewif_jax import models, scenarios, scores
from ewif_jax.analysis.anderson import (
    actual_error,
    error_bounds,
    steady_state,
    weighted_covariances,
    weighting_as_process_noise,
)
from ewif_jax.analysis.anderson_continuous import steady_state_continuous, weighting_as_input_noise
from ewif_jax.analysis.consistency import chi2_band, nees, nis, rmse
from ewif_jax.analysis.crlb import crlb
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
from ewif_jax.analysis.pcrlb import pcrlb, pcrlb_equivalent, pcrlb_late
from ewif_jax.analysis.stability import spectral_abscissa, spectral_radius
from ewif_jax.analysis.storage import Storage, storage
from ewif_jax.batch import run_batch
from ewif_jax.continuous.error import actual_error_continuous, error_bounds_continuous
from ewif_jax.continuous.kalman_bucy import kalman_bucy
from ewif_jax.estimator import run, step
from ewif_jax.estimators.bootstrap import bootstrap
from ewif_jax.estimators.ensemble import ensemble
from ewif_jax.estimators.ewif import ewif
from ewif_jax.estimators.extended import extended
from ewif_jax.estimators.fading import fading
from ewif_jax.estimators.information import information
from ewif_jax.estimators.kalman import kalman
from ewif_jax.estimators.limited_memory import limited_memory
from ewif_jax.estimators.square_root import square_root
from ewif_jax.estimators.unscented import unscented
from ewif_jax.fast.compiling import prepare_cpu
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
from ewif_jax.oosm.enkf1 import enkf1
from ewif_jax.oosm.enkf2 import enkf2
from ewif_jax.oosm.pf_extended import pf_extended
from ewif_jax.oosm.pf_fixed_point import pf_fixed_point
from ewif_jax.oosm.pf_retrodict import pf_retrodict
from ewif_jax.oosm.replay import replay
from ewif_jax.oosm.rts_reference import rts_reference
from ewif_jax.oosm.selective import selective
from ewif_jax.parallel import run_parallel
from ewif_jax.recursions.ensembles import fuse_ensembles
from ewif_jax.smoothers.batch_wls import batch_wls
from ewif_jax.smoothers.fixed_lag import fixed_lag
from ewif_jax.smoothers.fixed_lag_ewif import fixed_lag_ewif
from ewif_jax.smoothers.rts import rts
from ewif_jax.smoothers.savgol import savgol
from ewif_jax.smoothers.two_sided_ewif import two_sided_ewif
from ewif_jax.streams import stream
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
    "Storage",
    "Trace",
    "Transform",
    "Tuned",
    "a1",
    "actual_error",
    "actual_error_continuous",
    "al1",
    "alpha_beta_eigenvalues",
    "alpha_beta_gains",
    "asd",
    "b1",
    "batch_wls",
    "bl1",
    "bootstrap",
    "chi2_band",
    "crlb",
    "cutoff_delay",
    "delayed_gain",
    "drop_late",
    "enkf1",
    "enkf2",
    "ensemble",
    "equivalent_process_noise",
    "equivalent_tau",
    "error_bounds",
    "error_bounds_continuous",
    "ewif",
    "expected_mse",
    "extended",
    "fading",
    "fixed_lag",
    "fixed_lag_ewif",
    "fuse_ensembles",
    "gain_history",
    "information",
    "kalman",
    "kalman_bucy",
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
    "pcrlb",
    "pcrlb_equivalent",
    "pcrlb_late",
    "pf_extended",
    "pf_fixed_point",
    "pf_retrodict",
    "positive",
    "prediction_loss",
    "prepare_cpu",
    "psd",
    "random_walk_cutoff",
    "random_walk_gain",
    "replay",
    "rmse",
    "rmse_loss",
    "rts",
    "rts_reference",
    "run",
    "run_batch",
    "run_parallel",
    "savgol",
    "scenarios",
    "scores",
    "selective",
    "simulate_batch",
    "spectral_abscissa",
    "spectral_radius",
    "square_root",
    "steady_state",
    "steady_state_continuous",
    "steady_state_gain",
    "step",
    "storage",
    "stream",
    "tune",
    "two_sided_ewif",
    "unconstrained",
    "unscented",
    "weighted_covariances",
    "weighting_as_input_noise",
    "weighting_as_process_noise",
]
