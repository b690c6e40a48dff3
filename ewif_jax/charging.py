"""A batch whose rows are scored, or charged where the filter has no answer."""

from collections.abc import Callable
from functools import cache
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.core import Tracer

from ewif_jax import checks, plain, scores
from ewif_jax.arrival import initial
from ewif_jax.charges import (
    charged,
    truth_charges,
    value_charges,
)
from ewif_jax.fast.layout import broadcast_prefix, one_run
from ewif_jax.recursions.ahead import ahead
from ewif_jax.scores import Score, scored
from ewif_jax.streams import float_dtype
from ewif_jax.types import Estimator, Gaussian, Measurement, Numbers, Params

Unused = Literal["charge", "leave out"]


class Rows(NamedTuple):
    """Which rows are scored.

    where: None; bool (T,) or (R, T), which rows count; or with a last axis of components (the
        measurements' (..., m), of a truth (..., k)), which of their components do.
    warm_up: how many measured rows at the start of each run do not count.
    ahead: how many arrivals ahead a row is predicted.
    """

    where: Any = None
    warm_up: int = 0
    ahead: int = 1

    def checked(self, measurements: Measurement, size: int | None = None) -> "Rows":
        """The same, or an error if it does not fit; `size` is the number of components."""
        checks.whole("warm_up", self.warm_up, 0)
        checks.whole("ahead", self.ahead, 1)
        if self.where is None:
            return self
        where = self.where
        if not isinstance(where, Tracer):
            where = plain.booleans("where", where)
        value = np.shape(measurements.value)
        size = value[-1] if size is None else size
        fits = [value[:-1], value[-2:-1], (*value[:-1], size)]
        expected = "booleans of shape " + " or ".join(map(str, dict.fromkeys(fits)))
        ok = np.shape(where) in fits
        checks.require(ok, "where", expected, f"shape {np.shape(where)}")
        return self._replace(where=where)

    def apart(self, measurements: Measurement) -> tuple[Any, Any]:
        """What it says of rows, (T,) or (R, T), and of components, (1 or R, T, k); or None."""
        if self.where is None:
            return None, None
        if np.ndim(self.where) < np.ndim(measurements.value):
            return self.where, None
        where = self.where if np.ndim(self.where) == 3 else self.where[None]
        return where.any(-1), where

    def counted(self, batch: Measurement, rows: Any) -> Any:
        """Which rows count, (R, T) or (T,), as far as that needs no charge."""
        if self.warm_up == 0:
            return rows
        measured = (
            np.asarray(batch.mask, bool).any(-1) if _is_concrete(batch) else batch.mask.any(-1)
        )
        warm = measured.cumsum(-1) - measured >= self.warm_up
        if rows is None:
            return warm
        xp = jnp if isinstance(rows, Tracer) or not _is_concrete(batch) else np
        shape = np.broadcast_shapes(np.shape(rows), warm.shape)
        return xp.broadcast_to(rows, shape) & xp.broadcast_to(warm, shape)


ALL_ROWS = Rows()


class Charging(NamedTuple):
    """A batch to score: what it is filtered with, and the charges (R, T) by the states' number."""

    estimator: Estimator
    measurements: Measurement
    setting: dict[str, Any]
    charges: Callable[[int], Any]
    unused: Unused
    rows: Rows = ALL_ROWS

    def scored(self, params: Params, truth: Numbers, score: Score) -> Array:
        """Scores (R, T); NaN in rows that do not count."""
        values = self.raw(params, truth, score)
        return charged(values, self.charge(params)) if self.unused == "charge" else values

    def raw(self, params: Params, truth: Numbers, score: Score) -> Array:
        """Scores (R, T); NaN where the filter has no answer, and in rows left out by the user."""
        is_offered = self.unused in ("charge", "leave out")
        checks.require(is_offered, "unused", "'charge' or 'leave out'", repr(self.unused))
        rows, components = self.rows.apart(self.measurements)
        if components is not None:
            score = scores.of_components(score, truth is None)
        found = scored(
            self.estimator,
            params,
            self.measurements,
            truth,
            scores={"score": score},
            counted=components,
            **self.setting,
        )
        values = found["score"]
        counts = self.rows.counted(scores.as_batch(self.measurements), rows)
        if counts is None:
            return values
        return jnp.where(jnp.broadcast_to(jnp.asarray(counts), values.shape), values, jnp.nan)

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
    rows: Rows = ALL_ROWS,
) -> Charging:
    """How measurements are scored whose rows cost what `charges` says."""

    def fresh(unknowns: int) -> Any:
        batch = scores.as_batch(measurements)
        charge = charges(batch, unknowns)
        counts = rows.counted(batch, rows.apart(measurements)[0])
        if counts is None:
            return charge
        xp = np if isinstance(charge, np.ndarray) and isinstance(counts, np.ndarray) else jnp
        shape = np.broadcast_shapes(np.shape(charge), np.shape(counts))
        return xp.where(xp.broadcast_to(counts, shape), charge, xp.nan)

    @cache
    # Charges depend on the data alone, so all evaluations of a loss share them.
    def kept(unknowns: int) -> Any:
        # Else what is made of known numbers inside of a trace would belong to that trace.
        with jax.ensure_compile_time_eval():
            return fresh(unknowns)

    is_concrete = _is_concrete(measurements) and not isinstance(rows.where, Tracer)
    if rows.ahead > 1:
        estimator = ahead(estimator, rows.ahead, np.shape(measurements.value)[-1])
    return Charging(estimator, measurements, setting, kept if is_concrete else fresh, unused, rows)


def value_charging(
    estimator: Estimator,
    measurements: Measurement,
    cost: Callable[..., Any],
    unused: Unused,
    setting: dict[str, Any],
    rows: Rows = ALL_ROWS,
) -> Charging:
    """How measurements are scored whose rows cost `cost` where they are not predicted."""
    if not isinstance(measurements, Measurement):
        scores.as_batch(measurements)  # which says what is wrong
    rows = rows.checked(measurements)
    components = rows.apart(measurements)[1]

    def charges(batch: Measurement, unknowns: int) -> Any:
        return value_charges(batch, cost, unknowns, rows.ahead, components)

    return charging_of(estimator, measurements, charges, unused, setting, rows)


def truth_charging(
    estimator: Estimator,
    measurements: Measurement,
    truth: Numbers,
    unused: Unused,
    setting: dict[str, Any],
    rows: Rows = ALL_ROWS,
) -> Charging:
    """How measurements are scored whose rows cost the squared distance of the truth from its
    mean."""
    rows = rows.checked(measurements, np.shape(truth)[-1] if np.ndim(truth) else None)
    components = rows.apart(measurements)[1]

    def charges(batch: Measurement, unknowns: int) -> Any:
        return truth_charges(truth, batch, unknowns, components)

    return charging_of(estimator, measurements, charges, unused, setting, rows)


def _is_concrete(measurements: Measurement) -> bool:
    return not any(isinstance(x, Tracer) for x in measurements)


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
