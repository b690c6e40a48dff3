"""The value and gradient of a loss by whichever mode is cheaper."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array, lax
from jax.flatten_util import ravel_pytree

from ewif_jax.types import Params

Loss = Callable[..., Array]
FORWARD_UP_TO = 4


def value_and_gradient(loss: Loss, params: Params, *rest: Any) -> tuple[Array, Any]:
    """`loss(params, *rest)` and its gradient in `params`, a pytree of floats.

    Up to four numbers go through forward mode, which keeps no history, two of them in one pass;
    more through reverse mode.
    """
    flat, unflatten = ravel_pytree(params)
    if flat.size > FORWARD_UP_TO:
        return jax.value_and_grad(loss)(params, *rest)

    def loss_of_vector(x: Array) -> Array:
        return loss(unflatten(x), *rest)

    def along(pair: Array) -> tuple[Array, Array]:
        """The loss and its slopes in two directions, which share the pass of the loss itself.

        The second derivative is not used, so the compiler leaves it out.
        """
        first, second = pair
        (value, one), (other, _) = jax.jvp(
            lambda x: jax.jvp(loss_of_vector, (x,), (first,)), (flat,), (second,)
        )
        return value, jnp.stack([one, other])

    if flat.size == 1:
        value, slope = jax.jvp(loss_of_vector, (flat,), (jnp.ones_like(flat),))
        return value, unflatten(slope[None])
    # Directions in pairs, an odd one beside a row of zeros, whose slope is cut off: one program for
    # all pairs (`fast/slopes.py` says why pairs).
    directions = jnp.eye(flat.size + flat.size % 2, flat.size, dtype=flat.dtype)
    values, slopes = lax.map(along, directions.reshape(-1, 2, flat.size))
    return values[0], unflatten(slopes.reshape(-1)[: flat.size])
