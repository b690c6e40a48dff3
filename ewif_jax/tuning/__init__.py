"""Parameters from data: `tune`, and the value and gradient it goes by."""

from ewif_jax.tuning.minimise import tune
from ewif_jax.tuning.second_order import StandardErrors, standard_errors
from ewif_jax.tuning.tuned import Tuned
from ewif_jax.tuning.value_gradient import value_and_gradient

__all__ = ["StandardErrors", "Tuned", "standard_errors", "tune", "value_and_gradient"]
