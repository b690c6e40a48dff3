"""Changing between models: how likely, over an interval, and whose state can be mixed."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ewif_jax import checks
from ewif_jax.models import Model
from ewif_jax.models.angles import Angles
from ewif_jax.models.discrete import is_discrete, motion
from ewif_jax.models.domain import check_covariances
from ewif_jax.models.parameters import named
from ewif_jax.types import (
    Estimator,
    Gaussian,
    Numbers,
    Parameter,
    Params,
    State,
    Steps,
)

GAUSSIAN_FIELDS = {"time", "mean", "cov", "root", "variances", "rows", "targets"}
"""Of states that `init` makes from the time and a Gaussian, and that hold no more: a filter of
another kind whose state has no other fields can be mixed too."""
ROUNDING = 1e-5


class Chain(NamedTuple):
    """chances(params, t0, t1) -> (M, M), the probability to be in j at t1 after i at t0; steps: how
    time is counted if it is discrete."""

    chances: Callable[..., Array]
    steps: Steps | None


def chain_of(transition: Parameter, count: int, dt: float, max_steps: int) -> Chain:
    """The chain of a function (params, t0, t1), or of one step of `dt` seconds: (M, M), or a
    function of `params` alone."""
    is_number = checks.concrete_value(dt) is not None
    checks.require(is_number, "dt", "a number, not a parameter", "a tracer")
    steps = Steps(float(checks.positive_number("dt", dt)), checks.whole("max_steps", max_steps, 1))
    if not is_discrete(transition):
        return Chain(partial(_asked_chances, named(transition), count), None)
    if callable(transition):
        one_step = partial(_chances_of_params, named(transition), count)
    elif checks.concrete_value(transition) is None:
        one_step = partial(_chances_of_params, lambda params: transition, count)
    else:
        check_chances(transition, count)
        one_step = np.array(transition, float)
    # Powers of an F: nothing else is asked of a chain over many steps.
    moved = motion(one_step, None, None, None, steps)
    return Chain(moved.F, moved.steps)


def check_chances(chances: Numbers, count: int) -> Any:
    """Refuses what is known to be no matrix of probabilities with rows of sum one; returns it."""
    checks.shape("transition", chances, (count, count))
    checks.finite("transition", chances)
    _check_sum("transition", "rows of numbers in [0, 1] whose sum is 1", chances)
    return chances


def check_probabilities(weights: Numbers, count: int) -> Any:
    """Refuses what is known to be no probabilities (M,) of sum one; returns it."""
    checks.shape("probabilities", weights, (count,))
    checks.finite("probabilities", weights)
    _check_sum("probabilities", "numbers in [0, 1] whose sum is 1", weights)
    return weights


def is_one_gaussian(state: State) -> bool:
    """Whether a state holds its time, a mean and its covariance in some form, and no more."""
    fields = set(getattr(state, "_fields", ()))
    return "mean" in fields and fields <= GAUSSIAN_FIELDS


def check_members(
    estimators: Sequence[Estimator], params: Params, prior: Gaussian, t0: Numbers
) -> None:
    """Refuses filters whose states cannot be mixed."""
    n = np.shape(prior.mean)[0]
    for number, estimator in enumerate(estimators):
        argument = f"estimators[{number}]"
        # With a key, which those ask for that are refused in the next line.
        first = jax.eval_shape(partial(estimator.init, params, prior, t0), jax.random.key(0))
        checks.require(
            is_one_gaussian(first),
            argument,
            "a filter whose state is one mean and covariance (kalman, extended, unscented, "
            "information, square_root, fading, ewif; robust of these; for late data wrap the whole "
            "in replay)",
            checks.Shown(estimator),
        )
        found = jax.eval_shape(partial(estimator.estimate, params), first)
        checks.require(
            found.mean.shape == (n,), argument, f"a state of {n} numbers", found.mean.shape
        )


def joint_model(estimators: Sequence[Estimator], chain: Chain, count: int) -> Model | None:
    """One Model that answers for all in what entries ask before they trace: times and parameters.
    None if a filter has none."""
    models = [estimator.model for estimator in estimators]
    if any(model is None for model in models):
        return None
    counted = [model.steps for model in models if model.steps is not None]
    counted += [] if chain.steps is None else [chain.steps]
    steps = {step.dt for step in counted}
    checks.require(
        len(steps) < 2, "dt", "one step for all models and the transition", sorted(steps)
    )
    sensors = [model.sensors for model in models if model.sensors is not None]
    every_check = [
        model.check or check_covariances(model.process_cov, model.measurement_cov)
        for model in models
    ]

    def check(params: Params, t0: Numbers, t1: Numbers, seen: Numbers) -> None:
        for own in every_check:
            own(params, t0, t1, seen)
        end = t1 if chain.steps is None else t0 + chain.steps.dt
        check_chances(chain.chances(params, t0, end), count)

    return models[0]._replace(
        steps=min(counted, key=lambda step: step.max_steps) if counted else None,
        sensors=min(sensors, default=None),
        check=check,
    )


def mixed_angles(estimators: Sequence[Estimator]) -> Angles:
    """Which components of the state are angles in all models; None if none is, or a linear model
    lets them turn on."""
    models = [estimator.model for estimator in estimators]
    if any(model is None or model.linear is not None for model in models):
        return None
    said = {model.state_angle for model in models if model is not None}
    checks.require(
        len(said) == 1, "estimators", "models with one state_angle", sorted(map(str, said))
    )
    (angle,) = said
    return angle if angle is not None and any(angle) else None


def _asked_chances(
    asked: Callable[..., Any], count: int, params: Params, t0: Array, t1: Array
) -> Array:
    found = jnp.asarray(asked(params, t0, t1))
    checks.shape("transition", found, (count, count))
    return found


def _chances_of_params(asked: Callable[..., Any], count: int, params: Params) -> Array:
    found = jnp.asarray(asked(params))
    checks.shape("transition", found, (count, count))
    return found


def _check_sum(argument: str, expected: str, given: Numbers) -> None:
    value = checks.concrete_value(given)
    if value is not None:
        inside = (value >= -ROUNDING).all() and (abs(value.sum(-1) - 1) <= ROUNDING).all()
        checks.require(bool(inside), argument, expected, value.tolist())
