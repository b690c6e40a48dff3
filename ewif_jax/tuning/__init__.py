"""Parameters from data: `tune`, and the value and gradient it goes by."""

from ewif_jax.tuning.cross_validation import (
    CrossValidated,
    Fold,
    cross_validated,
    run_folds,
    time_folds,
)
from ewif_jax.tuning.minimise import tune
from ewif_jax.tuning.posterior import Posterior, posterior
from ewif_jax.tuning.profile import ProfileIntervals, profile_intervals
from ewif_jax.tuning.second_order import StandardErrors, standard_errors
from ewif_jax.tuning.tuned import Tuned
from ewif_jax.tuning.value_gradient import value_and_gradient

__all__ = [
    "CrossValidated",
    "Fold",
    "Posterior",
    "ProfileIntervals",
    "StandardErrors",
    "Tuned",
    "cross_validated",
    "posterior",
    "profile_intervals",
    "run_folds",
    "standard_errors",
    "time_folds",
    "tune",
    "value_and_gradient",
]
