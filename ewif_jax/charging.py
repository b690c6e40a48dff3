"""A batch whose rows are scored, or charged where the filter has no answer."""

from collections.abc import Callable
from functools import cache
from typing import Any, Literal, NamedTuple

import jax
from jax import Array
from jax.core import Tracer

from ewif_jax import checks, scores
from ewif_jax.arrival import initial
from ewif_jax.charges import (
    charged,
    value_charges,
)
from ewif_jax.fast.layout import broadcast_prefix, one_run
from ewif_jax.scores import Score, scored
from ewif_jax.streams import float_dtype
from ewif_jax.types import Estimator, Gaussian, Measurement, Numbers, Params

Unused = Literal["charge", "leave out"]


class Charging(NamedTuple):
    """A batch to score: what it is filtered with, and the charges (R, T) by the states' number."""

    estimator: Estimator
    measurements: Measurement
    setting: dict[str, Any]
    charges: Callable[[int], Any]
    unused: Unused

    def scored(self, params: Params, truth: Numbers, score: Score) -> Array:
        """Scores (R, T); NaN in rows that do not count."""
        values = self.raw(params, truth, score)
        return charged(values, self.charge(params)) if self.unused == "charge" else values

    def raw(self, params: Params, truth: Numbers, score: Score) -> Array:
        """Scores (R, T); NaN where the filter has no answer."""
        checks.require(self.unused in ("charge", "leave out"), "unused",
                       "'charge' or 'leave out'", repr(self.unused))  # fmt: skip
        found = scored(
            self.estimator,
            params,
            self.measurements,
            truth,
            scores={"score": score},
            **self.setting,
        )
        return found["score"]

    def charge(self, params: Params) -> Any:
        """What the rows cost; NaN in those that do not count."""
        prior = self.setting.get("prior")
        unknowns = 0
        if prior is None:
            unknowns = _state_size(self.estimator, params, self.measurements, self.setting)
        return self.charges(unknowns)


def charging_of(
    estimator: Estimator,
    measurements: Measurement,
    charges: Callable[[Measurement, int], Any],
    unused: Unused,
    setting: dict[str, Any],
) -> Charging:
    """How measurements are scored whose rows cost what `charges` says."""

    def fresh(unknowns: int) -> Any:
        return charges(scores.as_batch(measurements), unknowns)

    @cache
    def kept(unknowns: int) -> Any:
        # Else what is made of known numbers inside of a trace would belong to that trace.
        with jax.ensure_compile_time_eval():
            return fresh(unknowns)

    is_traced = any(isinstance(x, Tracer) for x in measurements)
    return Charging(estimator, measurements, setting, fresh if is_traced else kept, unused)


def value_charging(
    estimator: Estimator,
    measurements: Measurement,
    cost: Callable[..., Any],
    unused: Unused,
    setting: dict[str, Any],
) -> Charging:
    """How measurements are scored whose rows cost `cost` where they are not predicted."""

    def charges(batch: Measurement, unknowns: int) -> Any:
        return value_charges(batch, cost, unknowns)

    return charging_of(estimator, measurements, charges, unused, setting)


def _state_size(
    estimator: Estimator, params: Params, measurements: Measurement, setting: dict[str, Any]
) -> int:
    """How many numbers the state has whose estimate the filter reports."""
    dtype = float_dtype(measurements.value)
    own = one_run(params, broadcast_prefix(setting.get("params_per_run", False), params))

    def first(params: Params) -> Gaussian:
        state = initial(estimator, params, None, setting.get("t0", 0.0), dtype, setting.get("key"))
        return estimator.estimate(params, state)

    return jax.eval_shape(first, own).mean.shape[-1]
