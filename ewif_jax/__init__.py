"""Differentiable filtering with late measurements in JAX.

A model of the world (`linear_model`, `models`), an estimator (`ewif`, `kalman`, ...), and a stream
of measurements in arrival order go into `run`; `monte_carlo` and `tune` build on it. More is in the
rooms `analysis`, `continuous`, `losses`, `models`, `scenarios`, `scores`, `transforms` and `lab`.
"""

from importlib import import_module as _import_module
from importlib.util import find_spec as _find_spec
from typing import TYPE_CHECKING as _TYPE_CHECKING
from warnings import warn as _warn

from ewif_jax import analysis, continuous, losses, models, scenarios, scores, transforms
from ewif_jax.analysis.anderson import (
    actual_error,
    steady_state,
)
from ewif_jax.analysis.consistency import nees, nis, rmse
from ewif_jax.analysis.crlb import crlb
from ewif_jax.analysis.equivalence import equivalent_process_noise, equivalent_tau
from ewif_jax.analysis.expected import expected_mse
from ewif_jax.analysis.gain_history import gain_history
from ewif_jax.analysis.merit import (
    alpha_beta_gains,
    cutoff_delay,
    delayed_gain,
    maneuvering_index,
    random_walk_cutoff,
    random_walk_gain,
    steady_state_gain,
)
from ewif_jax.analysis.pcrlb import pcrlb, pcrlb_late
from ewif_jax.analysis.storage import Storage, storage
from ewif_jax.batch import run_batch
from ewif_jax.continuous.kalman_bucy import kalman_bucy
from ewif_jax.estimator import run
from ewif_jax.estimators.bootstrap import bootstrap
from ewif_jax.estimators.ensemble import ensemble
from ewif_jax.estimators.ewif import ewif
from ewif_jax.estimators.ewif_bank import bank_weights, ewif_bank
from ewif_jax.estimators.extended import extended
from ewif_jax.estimators.fading import fading
from ewif_jax.estimators.gated import gated
from ewif_jax.estimators.guided import guided
from ewif_jax.estimators.imm import imm, imm_probabilities
from ewif_jax.estimators.information import information
from ewif_jax.estimators.iterated_extended import iterated_extended
from ewif_jax.estimators.kalman import kalman
from ewif_jax.estimators.limited_memory import limited_memory
from ewif_jax.estimators.robust import robust
from ewif_jax.estimators.square_root import square_root
from ewif_jax.estimators.unscented import unscented
from ewif_jax.fast.compiling import prepare_cpu
from ewif_jax.latency import corrected
from ewif_jax.live import arrivals, forecast, step, step_batch
from ewif_jax.losses import (
    likelihood_loss,
    log_likelihood,
    nees_loss,
    nis_loss,
    prediction_loss,
    rmse_loss,
)
from ewif_jax.models import Model, linear_model
from ewif_jax.models.inputs import inputs
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
from ewif_jax.smoothers.batch_wls import batch_wls
from ewif_jax.smoothers.fixed_lag import fixed_lag
from ewif_jax.smoothers.fixed_lag_ewif import fixed_lag_ewif
from ewif_jax.smoothers.rts import rts
from ewif_jax.smoothers.savgol import savgol
from ewif_jax.smoothers.two_sided_ewif import two_sided_ewif
from ewif_jax.streams import arrival_order, newest, stream
from ewif_jax.transforms import Transform
from ewif_jax.tuning import (
    StandardErrors,
    Tuned,
    cross_validated,
    posterior,
    profile_intervals,
    run_folds,
    standard_errors,
    time_folds,
    tune,
)
from ewif_jax.types import Estimator, Gaussian, Info, Measurement, Status, Trace

__all__ = [
    "Estimator",
    "Gaussian",
    "Info",
    "Measurement",
    "Model",
    "Scenario",
    "Simulation",
    "StandardErrors",
    "Statistics",
    "Status",
    "Storage",
    "Trace",
    "Transform",
    "Tuned",
    "a1",
    "actual_error",
    "al1",
    "alpha_beta_gains",
    "analysis",
    "arrival_order",
    "arrivals",
    "asd",
    "b1",
    "bank_weights",
    "batch_wls",
    "bl1",
    "bootstrap",
    "continuous",
    "corrected",
    "crlb",
    "cross_validated",
    "cutoff_delay",
    "delayed_gain",
    "drop_late",
    "enkf1",
    "enkf2",
    "ensemble",
    "equivalent_process_noise",
    "equivalent_tau",
    "ewif",
    "ewif_bank",
    "expected_mse",
    "extended",
    "fading",
    "fixed_lag",
    "fixed_lag_ewif",
    "forecast",
    "gain_history",
    "gated",
    "guided",
    "imm",
    "imm_probabilities",
    "information",
    "inputs",
    "iterated_extended",
    "kalman",
    "kalman_bucy",
    "likelihood_loss",
    "limited_memory",
    "linear_model",
    "log_likelihood",
    "losses",
    "maneuvering_index",
    "models",
    "monte_carlo",
    "nees",
    "nees_loss",
    "newest",
    "nis",
    "nis_loss",
    "pcrlb",
    "pcrlb_late",
    "pf_extended",
    "pf_fixed_point",
    "pf_retrodict",
    "posterior",
    "prediction_loss",
    "prepare_cpu",
    "profile_intervals",
    "random_walk_cutoff",
    "random_walk_gain",
    "replay",
    "rmse",
    "rmse_loss",
    "robust",
    "rts",
    "rts_reference",
    "run",
    "run_batch",
    "run_folds",
    "run_parallel",
    "savgol",
    "scenarios",
    "scores",
    "selective",
    "simulate_batch",
    "square_root",
    "standard_errors",
    "steady_state",
    "steady_state_gain",
    "step",
    "step_batch",
    "storage",
    "stream",
    "time_folds",
    "transforms",
    "tune",
    "two_sided_ewif",
    "unscented",
]

_MOVED = {
    "Case": "analysis",
    "actual_error_continuous": "continuous",
    "alpha_beta_eigenvalues": "analysis",
    "chi2_band": "analysis",
    "error_bounds": "analysis",
    "error_bounds_continuous": "continuous",
    "fuse_ensembles": "analysis",
    "pcrlb_equivalent": "analysis",
    "positive": "transforms",
    "psd": "transforms",
    "spectral_abscissa": "analysis",
    "spectral_radius": "analysis",
    "steady_state_continuous": "continuous",
    "unconstrained": "transforms",
    "weighted_covariances": "analysis",
    "weighting_as_input_noise": "continuous",
    "weighting_as_process_noise": "analysis",
}
"""Names that were here in the last release, and the room where they are now."""


if not _TYPE_CHECKING:  # a checker shall say which names are not here

    def __getattr__(name: str) -> object:
        if name in _MOVED:
            there = f"{__name__}.{_MOVED[name]}"
            _warn(
                f"{__name__}.{name} is now {there}.{name}; the next release has the new name only",
                DeprecationWarning,
                stacklevel=2,
            )
            return getattr(_import_module(there), name)
        if name == "lab":
            try:
                return _import_module(f"{__name__}.lab")
            except ModuleNotFoundError as error:
                needed = "ewif_jax.lab needs what `pip install ewif_jax[lab]` installs"
                raise ImportError(f"{needed} ({error})") from error
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    # Rooms that are not public would be offered too: importing a module leaves its name here. The
    # laboratory is offered where it can be had: completion asks for whatever is offered.
    lab = ["lab"] if _find_spec(f"{__name__}.lab") is not None else []
    return [*__all__, *lab, *(name for name in globals() if name.startswith("__"))]
