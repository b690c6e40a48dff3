"""How equations about a state move and see, whatever model they are of."""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

from jax import Array

from ewif_jax.models import Model
from ewif_jax.recursions.information import InformationState, transport
from ewif_jax.recursions.linearised import Linearisation, sight_around, transport_around
from ewif_jax.recursions.sighting import Sight, sight
from ewif_jax.types import Measurement, Params


class Lines(NamedTuple):
    """How the equations of what is known move and see: transport(params, state, time, fade) ->
    state at `time`; look(params, state, measurement, growth) -> Sight, of which the R is yet to be
    multiplied by `growth`."""

    transport: Callable[..., InformationState]
    look: Callable[..., Sight]


def lines_of(model: Model, kind: Linearisation | None) -> Lines:
    """Those of a model made linear as `kind` says; None: of a linear one."""

    def look(
        params: Params, state: InformationState, measurement: Measurement, growth: Array
    ) -> Sight:
        del growth
        return sight(model, params, state.mean, state.time, measurement)

    if kind is None:
        return Lines(partial(transport, model), look)
    return Lines(partial(transport_around, kind, model), partial(sight_around, kind, model))
