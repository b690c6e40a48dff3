"""What a row of the data costs that a filter does not use or cannot predict.

A loss that left such rows out would reward parameters for losing them: the hardest rows leave the
average first. So the rows that count are fixed by the data alone, and where the filter has no
answer, the row costs what it costs a predictor that knows no more than the mean and the spread of
that sensor's values. A charge is NaN in rows that do not count.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.core import Tracer

from ewif_jax.fast.batched import total
from ewif_jax.kernels.forecasts import gaussian_crps, gaussian_energy
from ewif_jax.streams import float_dtype
from ewif_jax.types import Measurement, Numbers

Cost = Callable[[Any, Any, Any], Any]
"""(values minus their mean (..., m), spread (..., m), which are present (..., m)) -> (...,)"""

WIDTH = 10.0
"""How many times wider than the spread of the values the density of the charge is: so wide that
no filter that predicts at all does worse, and that one row's value hardly matters."""


def value_charges(
    measurements: Measurement,
    cost: Cost,
    unknowns: int,
    ahead: int = 1,
    components: Numbers = None,
) -> Any:
    """What each row (R, T) costs where the filter does not predict it.

    Rows count that have a component, after earlier rows have had `unknowns` components together:
    before, data cannot determine a state of so many numbers.

    Args:
        measurements: a batch: value (R, T, m); the other fields may lack the axis of runs.
        cost: of an error of the predictor that knows mean and spread.
        unknowns: how many components determine the state; 0 with a prior.
        ahead: how many measured rows earlier they have to have been measured.
        components: which count, (1 or R, T, m); None: all.
    """
    xp = _array_module(measurements.value, measurements.sensor, measurements.mask)
    # Sums of squares in float64: what float32 cannot square is still compared with its like.
    value = np.asarray(measurements.value, float) if xp is np else jnp.asarray(measurements.value)
    mask = xp.broadcast_to(xp.asarray(measurements.mask, bool), value.shape)
    present = mask & xp.isfinite(value)
    value = xp.where(present, value, 0)
    sensor = xp.broadcast_to(xp.asarray(measurements.sensor), value.shape[:2])
    error, spread = _about_the_mean(value, present, sensor)
    counted = _foreseen_rows(mask, unknowns, ahead)
    if components is not None:
        present = present & xp.broadcast_to(xp.asarray(components), present.shape)
        counted &= (mask & xp.broadcast_to(xp.asarray(components), mask.shape)).any(-1)
        error = xp.where(present, error, 0)
    charge = cost(error, xp.where(present, spread, 1), present)
    largest = float(jnp.finfo(float_dtype(measurements.value)).max) ** 0.5
    # A value whose square no float holds costs infinity for all parameters: no predictor is right
    # about it, and a finite charge would reward losing that row.
    too_large = (abs(value) > largest).any(-1)
    charge = xp.where(too_large | xp.isnan(charge), xp.inf, charge)
    return _in_dtype(xp.where(counted, charge, xp.nan), measurements.value)


def _foreseen_rows(mask: Numbers, unknowns: int, ahead: int) -> Any:
    """Which rows (R, T) are measured, `ahead` measured rows after `unknowns` components have
    been."""
    measured = mask.any(-1)
    components = mask.sum(-1).cumsum(-1)
    # Counted from the masks alone: whether the numbers determine a state depends on parameters, and
    # a loss whose rows parameters choose can be lowered by choosing fewer
    # (docs/decisions/tuning.md).
    first = (measured & (components < unknowns)).sum(-1, keepdims=True) + (unknowns > 0)
    earlier = measured.cumsum(-1) - measured
    # With a prior the first rows are predicted from that.
    back = (ahead - 1) * (unknowns > 0)
    return measured & (earlier - back >= first)


def truth_charges(
    truth: Numbers, measurements: Measurement, unknowns: int, components: Numbers = None
) -> Any:
    """The squared distance (R, T) or (T,) of the truth (..., k) from its mean over runs and rows.

    Rows count whose truth is a number, from the row on with which `unknowns` components have been
    measured; of `components` (1 or R, T, k) only those.
    """
    mask = measurements.mask
    xp = _array_module(truth, mask)
    truth = np.asarray(truth, float) if xp is np else jnp.asarray(truth)
    axes = tuple(range(truth.ndim - 1))
    is_given = _all_of_each(xp.isfinite(truth))
    filled = xp.where(is_given[..., None], truth, 0)
    mean = filled.sum(axes) / xp.maximum(is_given.sum(), 1)
    apart = filled - xp.broadcast_to(mean, filled.shape)
    if components is not None:
        shape = np.broadcast_shapes(apart.shape, np.shape(components))
        apart = xp.broadcast_to(apart, shape) * xp.asarray(components)
    charge = total(xp.square(apart[..., i]) for i in range(apart.shape[-1]))
    measured = xp.broadcast_to(unknowns, np.shape(mask)[:-1])
    if unknowns > 0:
        measured = xp.cumsum(xp.asarray(mask, bool).sum(-1), -1)
    shape = np.broadcast_shapes(is_given.shape, measured.shape, charge.shape)
    is_given, measured, charge = (xp.broadcast_to(x, shape) for x in (is_given, measured, charge))
    counted = is_given & (measured >= unknowns)
    return _in_dtype(xp.where(counted, charge, xp.nan), measurements.value)


def squared_cost(error: Numbers, spread: Numbers, present: Numbers) -> Any:
    """The squared error about the mean."""
    del spread, present
    return (error**2).sum(-1)


def length_cost(error: Numbers, spread: Numbers, present: Numbers) -> Any:
    """The length of the error about the mean."""
    return squared_cost(error, spread, present) ** 0.5


def crps_cost(error: Numbers, spread: Numbers, present: Numbers) -> Any:
    """The continuous ranked probability score of independent Gaussians `WIDTH` times as wide as the
    values spread, summed over components."""
    xp = _array_module(error, spread, present)
    score = gaussian_crps(jnp.asarray(error), jnp.asarray(WIDTH * spread))
    return xp.where(present, xp.asarray(score), 0).sum(-1)


def energy_cost(error: Numbers, spread: Numbers, present: Numbers) -> Any:
    """The energy score of the same Gaussians."""
    xp = _array_module(error, spread, present)
    wide = jnp.where(jnp.asarray(present), jnp.asarray(WIDTH * spread), 0)
    flat = wide.reshape(-1, wide.shape[-1])
    errors = jnp.where(jnp.asarray(present), jnp.asarray(error), 0).reshape(flat.shape)
    covs = jax.vmap(jnp.diag)(jnp.square(flat))
    return xp.asarray(jax.vmap(gaussian_energy)(errors, covs).reshape(wide.shape[:-1]))


def density_cost(error: Numbers, spread: Numbers, present: Numbers) -> Any:
    """Minus the log density of independent Gaussians `WIDTH` times as wide as the values spread."""
    xp = _array_module(error, spread, present)
    wide = WIDTH * spread
    log = xp.square(error / wide) / 2 + xp.log(wide) + np.log(2 * np.pi) / 2
    return xp.where(present, log, 0).sum(-1)


def charged(values: Array, charge: Numbers) -> Array:
    """Scores (R, T) with the charge in the rows that have none, NaN in those that do not count."""
    charge = jnp.broadcast_to(jnp.asarray(charge, values.dtype), values.shape)
    return jnp.where(jnp.isnan(charge), jnp.nan, jnp.where(jnp.isnan(values), charge, values))


def _all_of_each(flags: Any) -> Any:
    """Whether all of each vector (..., k) are: of a few numbers each, NumPy's reduction is slow."""
    if isinstance(flags, np.ndarray) and flags.all():
        return np.ones(flags.shape[:-1], bool)
    return flags.all(-1)


def _in_dtype(charge: Numbers, value: Numbers) -> Any:
    """In the dtype of the scores of these values; what it cannot hold is infinite."""
    with np.errstate(over="ignore"):
        return charge.astype(float_dtype(value))


def _about_the_mean(value: Numbers, present: Numbers, sensor: Numbers) -> tuple[Any, Any]:
    """Values (R, T, m) minus the mean of their sensor's, 0 where absent, and the spread of those.

    A sensor that always says the same has no spread; its density is then as wide as the value.
    """
    shape = value.shape
    xp = _array_module(value, present, sensor)
    flat, there, which = (x.reshape(-1, *x.shape[2:]) for x in (value, present, sensor))
    if xp is np:
        _, group = np.unique(which, return_inverse=True)
    else:
        # With traced sensors the number of groups is not known: as many as rows, most of them
        # empty.
        _, group = jnp.unique(which, return_inverse=True, size=which.size)
    group = group.reshape(-1)
    groups = int(group.max()) + 1 if xp is np else which.size
    count = xp.maximum(_group_sums(there.astype(flat.dtype), group, groups), 1)
    mean = (_group_sums(flat, group, groups) / count)[group]
    error = xp.where(there, flat - mean, 0)
    variance = (_group_sums(xp.square(error), group, groups) / count)[group]
    level = xp.where(mean == 0, 1, abs(mean))
    spread = xp.where(variance > 0, xp.sqrt(xp.where(variance > 0, variance, 1)), level)
    return error.reshape(shape), spread.reshape(shape)


def _group_sums(x: Numbers, group: Numbers, groups: int) -> Any:
    """Sums (groups, m) of the rows of x (N, m) in each group."""
    if isinstance(x, np.ndarray):
        return np.stack([np.bincount(group, column, groups) for column in x.T], -1)
    return jax.ops.segment_sum(x, group, groups)


def _array_module(*arrays: Any) -> Any:
    """NumPy while all values are known: what the data say once needs no compiled program."""
    return jnp if any(isinstance(x, Tracer) for x in arrays) else np
