"""Angles among the components of the state: compared on the circle, and averaged there."""

import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from ewif_jax import checks
from ewif_jax.models.model import Model
from ewif_jax.models.sensors import wrap_angle

Angles = tuple[bool, ...] | None
"""Which components of the state are angles; None: none."""


def wrapped_state(angle: Angles, x: Array) -> Array:
    """Differences of states (n, ...) with those of angles in (-pi, pi]."""
    if angle is None or not any(angle):
        return x
    checks.shape("state_angle", angle, x.shape[:1])
    which = np.asarray(angle).reshape(-1, *(1,) * (x.ndim - 1))
    return jnp.where(which, wrap_angle(jnp.where(which, x, 0)), x)


def state_difference(model: Model, x: Array, y: Array) -> Array:
    """x - y of two states (n,), as a filter of means and covariances needs it. What a linear model
    moves is never wrapped, and may differ by more than a turn."""
    return x - y if model.linear is not None else wrapped_state(model.state_angle, x - y)


def centre_of(angle: Angles, x: Array, weights: Array | None = None) -> Array:
    r"""A state (n,) amid those of x (n, N), from which they are counted: of angles the circular
    mean, :math:`\mathrm{atan2}(\sum w \sin x, \sum w \cos x)`, of the rest the first.

    No derivative goes through it: a mean is the same from wherever it is counted.
    """
    first = x[:, 0]
    if angle is None or not any(angle):
        return first
    checks.shape("state_angle", angle, x.shape[:1])
    which = np.asarray(angle)
    turned = lax.stop_gradient(jnp.where(which[:, None], x, 0))
    share = 1.0 if weights is None else lax.stop_gradient(weights)[None]
    east, north = jnp.sum(share * jnp.cos(turned), 1), jnp.sum(share * jnp.sin(turned), 1)
    return jnp.where(which, jnp.arctan2(north, east), first)
