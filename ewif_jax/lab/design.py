"""What a comparison is, before anything is computed: checked, and cut into units of work."""

from collections.abc import Mapping, Sequence
from itertools import product
from typing import Any, NamedTuple

import jax
import numpy as np
from jax import Array

from ewif_jax import checks
from ewif_jax.arrival import initial
from ewif_jax.fast.dependence import dependence, traced
from ewif_jax.lab import methods as lines
from ewif_jax.lab.methods import Method
from ewif_jax.lab.parametric import Simulate
from ewif_jax.monte_carlo import RUN_STEPS, Scenario, Simulation, one_run, takes_params
from ewif_jax.scores import Score, squared_error, squared_innovation
from ewif_jax.streams import float_dtype
from ewif_jax.types import DTypeLike, Gaussian, Numbers, Params, RandomKey

MOST_RUNS = 1_000_000
"""At a point of the grid, where runs are added until errors are small enough."""


class Limits(NamedTuple):
    """Limits of a metric: a run has `converged` once its score stays at or below the first, and is
    `lost` if its last score is above the second (or is none)."""

    converged: float | None = None
    lost: float | None = None


class Design(NamedTuple):
    """Everything that decides the numbers of a comparison.

    until: the relative standard error at which no more runs are added (`runs` is then the most);
    warm_up: seconds from t0 in which nothing is scored, or None; unknowns: how many measured
    components determine a state, where nobody has a prior; sizes: of the states, by method.
    """

    methods: dict[str, Method]
    scenario: Scenario
    axes: dict[str, tuple[float, ...]]
    metrics: dict[str, Score]
    limits: dict[str, Limits]
    runs: int
    until: float | None
    chunk: int
    key: RandomKey
    over_time: bool
    warm_up: float | None
    unknowns: int
    sizes: dict[str, int]
    steps: int

    @property
    def points(self) -> list[dict[str, float]]:
        """The points of the grid, the last axis fastest."""
        return [dict(zip(self.axes, x, strict=True)) for x in product(*self.axes.values())]

    @property
    def roots(self) -> set[str]:
        """Metrics whose mean is shown as its root: squared errors, and scores with an attribute
        `is_square`."""
        squares = (squared_error, squared_innovation)
        return {
            name
            for name, score in self.metrics.items()
            if score in squares or getattr(score, "is_square", False)
        }

    @property
    def chunks(self) -> int:
        """The most chunks of runs at a point."""
        return -(-self.runs // self.chunk)

    def runs_of(self, chunk: int) -> int:
        """How many runs are in a chunk: the last may have fewer."""
        return min(self.chunk, self.runs - chunk * self.chunk)

    def world_at(self, point: Mapping[str, float]) -> dict[str, Any] | None:
        """The parameters of the scenario at a point; None if it takes none."""
        if not takes_params(self.scenario):
            return None
        return {**(self.scenario.params or {}), **point}


def designed(
    methods: Any,
    scenario: Scenario,
    over: Mapping[str, Sequence[float]] | None,
    metrics: Mapping[str, Score] | None,
    limits: Mapping[str, Limits] | None,
    runs: int | str,
    most_runs: int | None,
    chunk: int | None,
    key: RandomKey,
    over_time: bool,
    warm_up: float | None,
) -> Design:
    """The design of what `compare` was asked for.

    Raises:
        ValueError: what is wrong with an argument, by name.
    """
    named = lines.as_methods(methods)
    expected = "a Scenario (simulate, prior, t0)"
    is_scenario = isinstance(scenario, Scenario)
    checks.require(is_scenario, "scenario", expected, type(scenario).__name__)
    checks.require(key is not None, "key", "a PRNG key (jax.random.key(0))", None)
    checks.random_key(key)
    axes = {name: _axis_numbers(name, values) for name, values in (over or {}).items()}
    count, until = _run_count(runs, most_runs)
    metrics = dict(metrics or {"squared_error": squared_error})
    for name, score in metrics.items():
        checks.require(callable(score), f"metrics[{name!r}]", "a score (`ej.scores`)", repr(score))
    limits = dict(limits or {})
    for name, found in limits.items():
        expected = f"one of the metrics {', '.join(metrics)}"
        checks.require(name in metrics, "limits", expected, repr(name))
        is_limits = isinstance(found, Limits)
        checks.require(is_limits, f"limits[{name!r}]", "lab.Limits(converged=, lost=)", repr(found))
    if warm_up is not None:
        checks.at_least("warm_up", warm_up, 0.0)
    simulation = _tried_scenario(scenario, axes, key)
    _check_axes(named, scenario, axes, key)
    steps, dtype = (
        simulation.measurements.value.shape[0],
        float_dtype(simulation.measurements.value),
    )
    first = {name: values[0] for name, values in axes.items()}
    sizes = {
        name: _state_size(f"methods[{name!r}]", method, first, scenario, dtype)
        for name, method in named.items()
    }
    if chunk is None:
        parts = -(-count // min(1024, max(RUN_STEPS // steps, 1)))
        chunk = -(-count // parts) if until is None else min(1024, max(RUN_STEPS // steps, 2))
    # A chunk that was asked for stays as it is: with fewer runs it is the same program.
    chunk = checks.whole("chunk", chunk, 1)
    return Design(
        named,
        scenario,
        axes,
        metrics,
        limits,
        count,
        until,
        chunk,
        key,
        over_time,
        None if warm_up is None else float(warm_up),
        max(sizes.values()) if scenario.prior is None else 0,
        sizes,
        steps,
    )


def _run_count(runs: int | str, most_runs: int | None) -> tuple[int, float | None]:
    """How many runs, or at most; and the relative error at which it is enough."""
    if not isinstance(runs, str):
        checks.require(most_runs is None, "most_runs", 'None, unless runs="until 1 %"', most_runs)
        return checks.whole("runs", runs, 2), None
    words = runs.replace("%", " %").split()
    expected = 'a whole number >= 2, or "until 1 %"'
    checks.require(len(words) == 3 and words[::2] == ["until", "%"], "runs", expected, repr(runs))
    try:
        share = float(words[1]) / 100
    except ValueError:
        share = 0.0
    checks.require(0 < share < 1, "runs", expected, repr(runs))
    return checks.whole("most_runs", most_runs or MOST_RUNS, 2), share


def _axis_numbers(name: str, values: Numbers) -> tuple[float, ...]:
    where, expected = f"over[{name!r}]", "a list of different numbers"
    checks.require(isinstance(name, str), "over", "names of axes", repr(name))
    taken = name not in ("method", "run", "step", "status", "metric")
    checks.require(taken, "over", "a name that no other dimension has", repr(name))
    array = np.asarray(values)
    is_list = array.ndim == 1 and array.size > 0 and array.dtype.kind in "iuf"
    remedy = f"{expected} (what is no number is a Method or a comparison of its own)"
    checks.require(is_list, where, remedy, repr(values))
    good = not np.isnan(array).any() and np.unique(array).size == array.size
    checks.require(good, where, expected, repr(values))
    return tuple(float(x) for x in array)


def _tried_scenario(
    scenario: Scenario, axes: Mapping[str, Sequence[float]], key: Array
) -> Simulation:
    """The shapes of a run at the first point."""
    params = _first_params(scenario, axes)
    try:
        found = jax.eval_shape(one_run(scenario), key, params)
    except KeyError as error:
        have = ", ".join(params or {}) or "none"
        raise ValueError(
            f"over: expected all parameters that the scenario's simulate(key, params) reads, got "
            f"{have}, without {error} (an axis, or a default in Scenario(..., params={{...}}))"
        ) from error
    is_simulation = isinstance(found, Simulation)
    checks.require(is_simulation, "scenario.simulate", "a Simulation", type(found).__name__)
    return found


def _first_params(scenario: Scenario, axes: Mapping[str, Sequence[float]]) -> Any:
    if not takes_params(scenario):
        return None
    return {**(scenario.params or {}), **{name: values[0] for name, values in axes.items()}}


def _check_axes(
    methods: Mapping[str, Method],
    scenario: Scenario,
    axes: Mapping[str, Sequence[float]],
    key: Array,
) -> None:
    """Every axis that a method asks for is there, and somebody uses each."""
    used: set[str] = set()
    for name, method in methods.items():
        asked = lines.axes_of(method.params)
        missing = sorted(asked - set(axes))
        have = f"an axis of over ({', '.join(axes) or 'there is none'})"
        checks.require(not missing, f"methods[{name!r}].params", have, ", ".join(missing))
        used |= asked
    params = _first_params(scenario, axes)
    if params is not None:
        program = traced(one_run(scenario), key, params)
        _check_told(scenario, params)
        for name in set(axes) - used:
            flags = (False, {other: other == name for other in params})
            if any(jax.tree.leaves(dependence(program, flags))):
                used.add(name)
    for name in axes:
        checks.require(
            name in used,
            f"over[{name!r}]",
            f"an axis that the scenario's simulate(key, params) reads as params[{name!r}], or that "
            f"a Method asks for by lab.axis({name!r})",
            "one that nobody uses",
        )


def _check_told(scenario: Scenario, params: Mapping[str, float]) -> None:
    """Prior and t0 are the scenario's, whatever the numbers."""
    simulate = scenario.simulate
    if not isinstance(simulate, Simulate):
        return
    program = traced(simulate.told, params)
    for name in params:
        flags = ({other: other == name for other in params},)
        depends = any(jax.tree.leaves(dependence(program, flags)))
        expected = "an axis on which neither the prior nor t0 of the scenario depends"
        checks.require(not depends, f"over[{name!r}]", expected, "one that changes them")


def _state_size(
    where: str, method: Method, point: Mapping[str, float], scenario: Scenario, dtype: DTypeLike
) -> int:
    """How many numbers a method's state has whose estimate it reports.

    Raises:
        ValueError: what a method cannot start from, with its place in `methods`.
    """
    told = method.told_by(scenario)

    def first(params: Params) -> Gaussian:
        key = jax.random.key(0)
        state = initial(method.estimator, params, told.prior, told.t0, dtype, key)
        return method.estimator.estimate(params, state)

    try:
        checks.prior(told.prior)
        found = jax.eval_shape(first, lines.at_point(method.params, point))
    except ValueError as error:
        raise ValueError(f"{where}: {error}") from error
    return found.mean.shape[-1]
