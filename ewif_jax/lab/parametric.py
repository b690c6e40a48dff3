"""Builders of scenarios as one scenario whose numbers are parameters."""

import inspect
from collections.abc import Callable, Mapping
from functools import cached_property
from typing import Any

from jax import Array

from ewif_jax import checks
from ewif_jax.monte_carlo import Scenario, Simulation
from ewif_jax.recipe import content_key
from ewif_jax.types import Params


def parametric(builder: Callable[..., Scenario], **fixed: Any) -> Scenario:
    """A scenario of which every number of `builder` can be an axis: `parametric(random_walk,
    steps=100)` over {"mean_delay": [0.2, 1.0]}.

    What decides shapes (how many steps) is fixed here. The numbers have to leave prior and t0 alone
    (`compare` refuses an axis on which they depend).

    Args:
        builder: function of numbers by name -> Scenario (`ewif_jax.scenarios`), that takes traced
            numbers.
        fixed: its other arguments.

    Raises:
        ValueError: what is no builder; an argument that it does not have.
    """
    checks.require(callable(builder), "builder", "a function that makes a Scenario", repr(builder))
    names = inspect.signature(builder).parameters
    strange = sorted(set(fixed) - set(names))
    checks.require(not strange, "fixed", f"arguments among {', '.join(names)}", ", ".join(strange))
    made = builder(**fixed)
    checks.require(isinstance(made, Scenario), "builder", "one of a Scenario", type(made).__name__)
    return Scenario(Simulate(builder, fixed), made.prior, made.t0, made.clock)


class Simulate:
    """simulate(key, params) of a builder; equal for the same builder and equal arguments."""

    def __init__(self, builder: Callable[..., Scenario], fixed: Mapping[str, Any]) -> None:
        self.builder = builder
        self.fixed = dict(fixed)

    def __call__(self, key: Array, params: Params) -> Simulation:
        """A run of the scenario with these numbers."""
        return self._built(params).simulate(key)

    def told(self, params: Params) -> tuple[Any, Any]:
        """Prior and t0 with these numbers."""
        made = self._built(params)
        return made.prior, made.t0

    def _built(self, params: Params) -> Scenario:
        # An axis may be of the methods alone.
        own = {k: v for k, v in params.items() if k in self._names and k not in self.fixed}
        return self.builder(**self.fixed, **own)

    @cached_property
    def _names(self) -> frozenset[str]:
        return frozenset(inspect.signature(self.builder).parameters)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Simulate):
            return False
        return self.builder is other.builder and self._key == other._key

    def __hash__(self) -> int:
        return hash((self.builder, self._key))

    @cached_property
    def _key(self) -> Any:
        return content_key(self.fixed)
