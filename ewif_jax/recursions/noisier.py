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


def _of_params_inside(function: Callable[..., Any]) -> Callable[..., Any]:
    """A function of (params, ...) as one of (Noisy, ...)."""

    @wraps(function)
    def called(noisy: Noisy, *args: Any) -> Any:
        return function(noisy.params, *args)

    return called


@from_recipe
def _noisier_model(model: Model) -> Model:
    def scaled(cov: Callable[..., Array]) -> Callable[..., Array]:
        def covariance(noisy: Noisy, *args: Any) -> Array:
            return domain.scaled(noisy.factor, cov(noisy.params, *args))

        return covariance

    linear = model.linear
    if linear is not None:
        linear = linear._replace(**_functions_inside(linear))
    return model._replace(
        **_functions_inside(model, "residual"),
        measurement_cov=scaled(model.measurement_cov),
        jitter=None if model.jitter is None else scaled(model.jitter),
        linear=linear,
    )


def _functions_inside(fields: Any, *kept: str) -> dict[str, Any]:
    """The functions of `params` in a named tuple as functions of `Noisy`."""
    kept = (*kept, "measurement_cov", "jitter", "linear")
    every = fields._asdict().items()
    return {k: _of_params_inside(f) for k, f in every if callable(f) and k not in kept}
