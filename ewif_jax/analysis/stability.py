"""Stability of a filter's error, and when a stationary filter exists."""

from collections.abc import Callable

import jax.numpy as jnp
import numpy as np
from jax import Array

from ewif_jax import checks

Edge = Callable[[np.ndarray], np.ndarray]


def spectral_radius(closed_loop: Array) -> Array:
    r"""The largest :math:`|\lambda|` (); with exponential weighting at most :math:`1/\alpha`
    (Anderson 1973, section 5, property 2)."""
    return jnp.max(jnp.abs(jnp.linalg.eigvals(closed_loop)))


def spectral_abscissa(closed_loop: Array) -> Array:
    r"""The largest real part (); with exponential weighting at most :math:`-\alpha`
    (Anderson 1973, section 4, the degree of stability)."""
    return jnp.max(jnp.real(jnp.linalg.eigvals(closed_loop)))


def require_steady_state(F: Array, H: Array, Q: Array, *, on_edge: Edge) -> None:
    """Refuses known matrices without a stationary filter; traced ones pass (their result is NaN).

    `on_edge` of eigenvalues is negative inside the region of stability and 0 on its boundary. By
    Popov, Belevitch and Hautus, every mode not inside has to be seen through H, and every mode on
    the boundary has to be driven by Q.
    """
    values = [checks.concrete_value(x) for x in (F, H, Q)]
    if any(value is None for value in values):
        return
    F_known, H_known, Q_known = (np.asarray(value, float) for value in values)
    n = F_known.shape[0]
    scale = max(np.abs(F_known).max(initial=0.0), 1.0)
    tolerance = 1e-9 * scale
    for eigenvalue in np.linalg.eigvals(F_known):
        place = float(on_edge(np.asarray([eigenvalue]))[0])
        shifted = F_known - eigenvalue * np.eye(n)
        seen = _numerical_rank(np.vstack([shifted, H_known]), tolerance)
        checks.require(
            place < -tolerance or seen == n,
            "H",
            "measurements that see every mode that does not decay (observability)",
            f"none of the mode with eigenvalue {eigenvalue:.6g}",
        )
        driven = _numerical_rank(np.hstack([shifted, Q_known]), tolerance)
        checks.require(
            abs(place) > tolerance or driven == n,
            "Q",
            "noise (or weighting) in every mode that neither grows nor decays",
            f"none in the mode with eigenvalue {eigenvalue:.6g}",
        )


def _numerical_rank(matrix: np.ndarray, tolerance: float) -> int:
    return int(np.linalg.matrix_rank(matrix, tol=tolerance))
