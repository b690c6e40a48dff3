"""What every recursion has in common: it turns plain maths into an `Estimator`."""

import jax.numpy as jnp
from jax import Array

from ewif_jax.types import Status


def verdict(
    late: Array,
    present: Array,
    late_status: Status | Array = Status.TOO_LATE,
    good: Array | bool = True,
) -> Array:
    """The status of an update that has nothing more to say than "late", "present" and "good"."""
    status = jnp.where(late, late_status, Status.USED)
    status = jnp.where(good | (status == Status.TOO_LATE), status, Status.REJECTED)
    return jnp.where(present, status, Status.MASKED).astype(jnp.int32)
