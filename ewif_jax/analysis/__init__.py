"""What a filter is worth: merit of late data, bounds, actual errors, consistency, equivalences."""

from ewif_jax.analysis.anderson import (
    System,
    actual_error,
    error_bounds,
    steady_state,
    weighted_covariances,
    weighting_as_process_noise,
)
from ewif_jax.analysis.consistency import chi2_band, nees, nis, rmse
from ewif_jax.analysis.crlb import crlb
from ewif_jax.analysis.equivalence import Case, equivalent_process_noise, equivalent_tau
from ewif_jax.analysis.expected import expected_mse
from ewif_jax.analysis.gain_history import gain_history
from ewif_jax.analysis.merit import (
    alpha_beta_eigenvalues,
    alpha_beta_gains,
    cutoff_delay,
    delayed_gain,
    maneuvering_index,
    random_walk_cutoff,
    random_walk_gain,
    steady_state_gain,
)
from ewif_jax.analysis.pcrlb import pcrlb, pcrlb_equivalent, pcrlb_late
from ewif_jax.analysis.stability import spectral_abscissa, spectral_radius
from ewif_jax.analysis.storage import Storage, storage
from ewif_jax.recursions.ensembles import fuse_ensembles

__all__ = [
    "Case",
    "Storage",
    "System",
    "actual_error",
    "alpha_beta_eigenvalues",
    "alpha_beta_gains",
    "chi2_band",
    "crlb",
    "cutoff_delay",
    "delayed_gain",
    "equivalent_process_noise",
    "equivalent_tau",
    "error_bounds",
    "expected_mse",
    "fuse_ensembles",
    "gain_history",
    "maneuvering_index",
    "nees",
    "nis",
    "pcrlb",
    "pcrlb_equivalent",
    "pcrlb_late",
    "random_walk_cutoff",
    "random_walk_gain",
    "rmse",
    "spectral_abscissa",
    "spectral_radius",
    "steady_state",
    "steady_state_gain",
    "storage",
    "weighted_covariances",
    "weighting_as_process_noise",
]
