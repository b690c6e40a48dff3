"""Where a sensor is and how it moves: what is given, at any time, as an array."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from ewif_jax import checks
from ewif_jax.models.parameters import named, of_params
from ewif_jax.types import DTypeLike, Numbers, Params

Place = Any
"""(dims,), or a function (params, t) -> (dims,), or of `params` alone."""
PlaceAt = Callable[[Params, Numbers, DTypeLike], Array]
"""(params, t, dtype) -> (dims,)"""


def place_of(argument: str, place: Place, dims: int) -> PlaceAt:
    """A place (or a velocity) as a function of (params, t, dtype).

    Raises:
        ValueError: not (dims,), or not finite.
    """
    if not callable(place):
        checks.shape(argument, place, (dims,))
        checks.finite(argument, place)
        return lambda params, t, dtype: jnp.asarray(place, dtype)
    given, alone = named(place), of_params(place)

    def placed(params: Params, t: Numbers, dtype: DTypeLike) -> Array:
        found = given(params) if alone else given(params, t)
        checks.shape(argument, found, (dims,))
        return jnp.asarray(found, dtype)

    return placed


def motion_of(place: Place, velocity: Place, dims: int) -> PlaceAt:
    """The velocity of a sensor: as given; or, with None, how fast its position changes with t."""
    if velocity is not None:
        return place_of("velocity", velocity, dims)
    position = place_of("position", place, dims)
    if not callable(place) or of_params(place):
        return lambda params, t, dtype: jnp.zeros(dims, dtype)

    def speed(params: Params, t: Numbers, dtype: DTypeLike) -> Array:
        t = jnp.asarray(t, dtype)
        here = (t,), (jnp.ones_like(t),)
        return jax.jvp(lambda t: position(params, t, dtype), *here)[1]

    return speed
