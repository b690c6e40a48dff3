"""What information forms refuse: what has no inverse."""

import jax
import jax.numpy as jnp
import numpy as np

from ewif_jax import checks
from ewif_jax.models import Model
from ewif_jax.types import Numbers, Params


def refuse_exact(model: Model, params: Params, t0: Numbers, method: str) -> None:
    """Refuses a known R that is not positive definite."""
    for sensor in range(model.sensors or 1):
        with jax.ensure_compile_time_eval():
            R = checks.concrete_value(model.measurement_cov(params, np.int32(sensor), t0))
        if R is None or R.ndim != 2 or R.shape[0] != R.shape[1]:
            continue
        R = R.astype(float)
        diagonal = np.diagonal(R)
        name = "R" if (model.sensors or 1) == 1 else f"R of sensor {sensor}"
        good = bool(np.all(diagonal > 0) and np.all(np.isfinite(R)))
        smallest = float(np.min(diagonal, initial=np.inf))
        if good:
            scale = np.sqrt(diagonal)
            # Of the correlations, so that units (a range in metres beside an angle in radians) do
            # not make a good R look singular.
            smallest = float(np.linalg.eigvalsh(R / scale[:, None] / scale).min(initial=np.inf))
            good = smallest > 8 * len(R) * np.finfo(np.float32).eps * 1e-6
        checks.require(
            good,
            name,
            f"a positive definite covariance: {method} adds up R^-1, which an exact measurement "
            "has not (kalman, information, fading, square_root, al1 and the like take one; or "
            "give it a small variance)",
            f"smallest eigenvalue {smallest:.3g}",
        )


def refuse_one_way(model: Model, params: Params, method: str) -> None:
    """Refuses a known F that has no inverse."""
    linear, steps = model.linear, model.steps
    if linear is None or steps is None:
        return
    back = None
    if linear.F_where is None and linear.reversible:  # not a constant, whose rank is known
        with jax.ensure_compile_time_eval():
            back = checks.concrete_value(linear.F(params, jnp.asarray(steps.dt), jnp.zeros(())))
    checks.require(
        linear.reversible and (back is None or bool(np.isfinite(back).all())),
        "F",
        f"a matrix that has an inverse: {method} moves what is known back in time (kalman, fading "
        "and square_root do not)",
        "a singular one",
    )
