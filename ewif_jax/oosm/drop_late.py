"""Leaving late measurements out."""

from typing import Any

from ewif_jax import checks
from ewif_jax.recipe import from_recipe
from ewif_jax.recursions.contract import offered
from ewif_jax.types import Estimator, Info, Measurement, Params, State


@from_recipe
def drop_late(estimator: Estimator) -> Estimator:
    """The estimator that uses a measurement only if it is not older than the state.

    A late one leaves the state as it is, with status `TOO_LATE`: the baseline of every comparison
    of methods (KF in Yoder et al., PFstd in Orguner & Gustafsson).

    Args:
        estimator: any `Estimator`; its states are used unchanged.

    Reduces to: the estimator itself on a stream in order of validity time.

    Raises:
        ValueError: `estimator` is not an `Estimator`.
    """
    checks.estimator(estimator)

    init, predict, take, estimate = estimator[:4]

    def update(params: Params, state: State, measurement: Measurement) -> tuple[Any, Info]:
        in_sequence = measurement.time >= state.time
        return offered(take, params, state, measurement, in_sequence)

    return Estimator(init, predict, update, estimate, model=estimator.model)
