"""What is compared: an estimator, its parameters at every point of a grid, and what it is told."""

from collections.abc import Callable, Mapping
from typing import Any, Literal, NamedTuple

import jax

from ewif_jax import checks
from ewif_jax.monte_carlo import Scenario
from ewif_jax.types import Estimator, Gaussian, Numbers, Params, RandomKey

FromScenario = Literal["scenario"]
SCENARIO: FromScenario = "scenario"
"""Stands for what the scenario says."""


class axis(NamedTuple):
    """The number of an axis of the grid, as a parameter of a method: `axis("q")`.

    name: an axis of `over`; transform: function number -> parameter, applied before tracing, for
    instance the entry of a table.
    """

    name: str
    transform: Callable[[float], Any] | None = None

    def at_point(self, point: Mapping[str, float]) -> Any:
        """What stands here at a point of the grid."""
        number = point[self.name]
        return number if self.transform is None else self.transform(number)


class Tuning(NamedTuple):
    """How a method's own parameters are tuned at every point of the grid, on runs of their own.

    runs: how many; key: of these runs (default: derived from the key of the comparison, apart from
    every compared run); steps: of the gradient descent; loss: function (estimator, measurements,
    truth, **what it is told) -> loss of params (default `losses.rmse_loss`).
    """

    runs: int = 16
    key: RandomKey = None
    steps: int = 60
    loss: Callable[..., Any] | None = None


class Told(NamedTuple):
    """What a filter is told at the start, and its clock."""

    prior: Gaussian | None
    t0: Numbers
    clock: Any


class _MethodFields(NamedTuple):
    estimator: Estimator
    params: Params = None
    prior: Gaussian | FromScenario | None = SCENARIO
    t0: Numbers | FromScenario = SCENARIO
    clock: str = SCENARIO
    tune: Tuning | None = None


class Method(_MethodFields):
    """One line of a comparison.

    estimator: any `Estimator`; params: its parameters, in which `axis(name)` stands for the number
    of an axis; prior, t0, clock: what the scenario says, unless given (`prior=None`: nothing is
    known); tune: a `Tuning`, which changes every number of `params` that is no axis.
    """

    def told_by(self, scenario: Scenario) -> Told:
        """What this method is told in a scenario."""

        def chosen(own: Any, of_scenario: Any) -> Any:
            return of_scenario if isinstance(own, str) and own == SCENARIO else own

        return Told(
            chosen(self.prior, scenario.prior),
            chosen(self.t0, scenario.t0),
            chosen(self.clock, scenario.clock),
        )


def as_methods(methods: Any) -> dict[str, Method]:
    """Methods by name; an estimator without parameters stands for its method.

    Raises:
        ValueError: no methods, a name that is no word, something that is no method.
    """
    named = isinstance(methods, Mapping) and len(methods) > 0
    checks.require(named, "methods", "methods by name, {'Kalman': kalman(model), ...}", methods)
    found = {}
    for name, method in methods.items():
        words = isinstance(name, str) and name.strip() != ""
        checks.require(words, "methods", "names that are words", repr(name))
        where = f"methods[{name!r}]"
        if isinstance(method, Estimator):
            method = Method(method)
        expected = "an Estimator, or lab.Method(estimator, params)"
        checks.require(isinstance(method, Method), where, expected, type(method).__name__)
        checks.estimator(method.estimator)
        tuned = method.tune is None or isinstance(method.tune, Tuning)
        checks.require(tuned, f"{where}.tune", "a lab.Tuning or None", repr(method.tune))
        found[name] = method
    return found


def axes_of(params: Params) -> set[str]:
    """The axes that a method asks for."""
    leaves = jax.tree.leaves(params, is_leaf=is_axis)
    return {x.name for x in leaves if is_axis(x)}


def at_point(params: Params, point: Mapping[str, float]) -> Any:
    """Parameters with the numbers of a point of the grid in the places of its axes."""
    return jax.tree.map(lambda x: x.at_point(point) if is_axis(x) else x, params, is_leaf=is_axis)


def is_axis(x: object) -> bool:
    """Whether it stands for the number of an axis."""
    return isinstance(x, axis)
