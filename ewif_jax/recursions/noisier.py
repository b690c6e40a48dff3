"""An estimator whose measurement noise is a factor larger for the measurement at hand."""

from collections.abc import Callable
from functools import wraps
from typing import Any, NamedTuple

import jax
from jax import Array

from ewif_jax.models import Model, domain
from ewif_jax.recipe import from_recipe
from ewif_jax.types import Estimator, Measurement, Params, State


class Noisy(NamedTuple):
    """params, and factor (): by how much R is larger."""

    params: Params
    factor: Array


def rebuilt(estimator: Estimator, changed: Callable[[Any], Any]) -> Estimator:
    """What the estimator's builder makes of its arguments, each of them `changed`."""
    recipe = estimator.recipe
    assert recipe is not None
    args = tuple(map(changed, recipe.args))
    return recipe.builder(*args, **{name: changed(x) for name, x in recipe.kwargs.items()})


def wraps_others(estimator: Estimator) -> bool:
    """Whether its builder was given estimators."""
    recipe = estimator.recipe
    given = () if recipe is None else (*recipe.args, *recipe.kwargs.values())
    leaves = jax.tree.leaves(given, is_leaf=lambda x: isinstance(x, Estimator))
    return any(isinstance(x, Estimator) for x in leaves)


def noisier(estimator: Estimator) -> Estimator:
    """The estimator, made of a Model, that takes `Noisy` parameters; with its own states."""
    # What a builder was given is models, functions of `params`, and what is no parameter: so the
    # factor reaches R as a parameter does, in whatever form a filter uses R.
    return rebuilt(estimator, _given_noisy)


def keeps_measurements(state: State) -> bool:
    """Whether a state has measurements in it, of which it does not know the factors."""
    leaves = jax.tree.leaves(state, is_leaf=lambda x: isinstance(x, Measurement))
    return any(isinstance(x, Measurement) for x in leaves)


def _given_noisy(x: Any) -> Any:
    if isinstance(x, Model):
        return _noisier_model(x)
    return _of_params_inside(x) if callable(x) else x


def _of_params_inside(function: Callable[..., Any] | None) -> Any:
    """A function of (params, ...) as one of (Noisy, ...)."""
    if function is None:
        return None

    @wraps(function)
    def called(noisy: Noisy, *args: Any) -> Any:
        return function(noisy.params, *args)

    return called


@from_recipe
def _noisier_model(model: Model) -> Model:
    def measurement_cov(noisy: Noisy, sensor: Array, t: Array) -> Array:
        return domain.scaled(noisy.factor, model.measurement_cov(noisy.params, sensor, t))

    linear = model.linear
    if linear is not None:
        F, b, H = map(_of_params_inside, linear[:3])
        linear = linear._replace(F=F, b=b, H=H)
    return model._replace(
        transition=_of_params_inside(model.transition),
        process_cov=_of_params_inside(model.process_cov),
        observe=_of_params_inside(model.observe),
        measurement_cov=measurement_cov,
        linear=linear,
        check=_of_params_inside(model.check),
    )
