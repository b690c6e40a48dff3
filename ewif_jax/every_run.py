"""What is refused of every run of a batch before anything is traced."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.tree_util import keystr, tree_leaves_with_path

from ewif_jax import checks, clocks
from ewif_jax.arrival import Screened, screen
from ewif_jax.checks import require
from ewif_jax.fast.layout import broadcast_prefix, one_run
from ewif_jax.fast.memo import once
from ewif_jax.models.components import check_components
from ewif_jax.models.entry import check_times
from ewif_jax.streams import float_dtype
from ewif_jax.trial import validated
from ewif_jax.types import Estimator, Gaussian, Measurement, Numbers, Params, PyTree, RandomKey


class Content(NamedTuple):
    """What is known of the values of a batch before anything is compiled."""

    complete: bool
    """Nothing is masked, which the compiled program then need not look for."""
    screened: bool
    """What is not a number has been taken out (see `arrival.screen`)."""


@once
def examined(
    estimator: Estimator,
    params: Params,
    params_per_run: PyTree,
    measurements: Measurement,
    prior: Gaussian | None,
    t0: Numbers,
    times: Numbers,
    clock: Any,
    key: RandomKey,
) -> tuple[Any, Content, Screened | None]:
    """Which inputs differ by run, what is known of the values, and the measurements without what
    is not a number if there is such; everything that can be refused now is."""
    checks.shape("measurements.value", measurements.value, ("R", "T", "m"))
    runs, steps = np.shape(measurements.value)[:2]
    checks.random_key(key, runs)
    _check_prior_axes(prior, runs)
    if times is not None:
        checks.report_times(times, steps)
        each = np.ndim(times) < 2 or np.shape(times)[0] == runs
        require(each, "times", f"{runs} runs", f"shape {np.shape(times)}")
    sifted = _sifted_measurements(measurements)
    shown = sifted.measurements if sifted else measurements
    inputs, flags = flagged(params, params_per_run, shown, prior, times)
    same_runs("params", params, flags[0], runs)
    if clock == "arrival" and times is not None:
        dtype = float_dtype(measurements.value)
        clocks.not_ahead(dtype, measurements.time, measurements.mask, times, t0)
    check_runs(estimator, inputs, flags, t0, clock, key)
    mask = checks.concrete_value(shown.mask)
    complete = mask is not None and bool(mask.all())
    return flags, Content(complete, _values_at_hand(measurements)), sifted


def _values_at_hand(measurements: Measurement) -> bool:
    return not any(isinstance(x, Tracer) for x in measurements)


def _sifted_measurements(measurements: Measurement) -> Screened | None:
    """The measurements at hand without what is not a number; None if all are numbers. Only a batch
    in which some are not pays for a mask, and so a gain, for every run."""
    dtype = float_dtype(measurements.value)
    if not _values_at_hand(measurements):
        return None
    same_dtype = np.asarray(measurements.value).dtype == dtype
    # The usual case in one pass over the values: a batch without bad numbers makes no copy and no
    # mask.
    if same_dtype and checks.squares_are_finite(measurements.value):
        return None
    screened = screen(jax.tree.map(np.asarray, measurements), dtype)
    return screened if screened.refused.any() else None


def flagged(
    params: Params,
    params_per_run: PyTree,
    measurements: Measurement,
    prior: Gaussian | None,
    times: Numbers,
) -> tuple[Any, Any]:
    """(params, measurements, prior, times), and the same with a bool for each leaf: whether it has
    a leading axis of runs."""
    flags = (
        per_run_flags("params", params_per_run, params),
        ranked(measurements, (1, 2, 1, 2)),
        None if prior is None else ranked(prior, (1, 2)),
        None if times is None else jnp.ndim(times) == 2,
    )
    return (params, measurements, prior, times), flags


def per_run_flags(argument: str, prefix: PyTree, tree: PyTree) -> Any:
    """A bool for each leaf of `tree` from a prefix of it.

    Raises:
        ValueError: `prefix` is not one.
    """
    try:
        return broadcast_prefix(prefix, tree)
    except (ValueError, TypeError) as error:
        raise ValueError(
            f"{argument}_per_run: expected True, False, or a pytree of these that is a prefix of "
            f"`{argument}`, got {prefix!r}"
        ) from error


def same_runs(
    argument: str, tree: PyTree, flags: PyTree, runs: int, steps: int | None = None
) -> None:
    """Refuses a leaf marked as one of each run that has not as many, and with `steps` one that has
    another number of arrivals."""
    marks = jax.tree.leaves(flags)
    for (path, x), per_run in zip(tree_leaves_with_path(tree), marks, strict=True):
        want = ((runs,) if per_run else ()) + (() if steps is None else (steps,))
        expected = [f"{runs} runs"] * bool(per_run) + [f"{steps} arrivals"] * (steps is not None)
        fits = np.shape(x)[: len(want)] == want
        shown = " and ".join(expected) + " along the leading axes"
        require(fits, f"{argument}{keystr(path)}", shown, f"shape {np.shape(x)}")


def check_runs(
    estimator: Estimator, inputs: PyTree, flags: PyTree, t0: Numbers, clock: Any, key: RandomKey
) -> None:
    """Refuses what `run` refuses: with the first run for all, the largest sensor of any run, and
    the priors and parameters also of the runs in which they are lowest."""
    params, params_f = inputs[0], flags[0]
    dtype = float_dtype(inputs[1].value)
    check_times(estimator.model, inputs[1], t0, dtype, inputs[3])
    check_components(estimator.model, inputs[1])
    _, measurements, prior, times = one_run(inputs, flags)
    sensors = checks.concrete_value(inputs[1].sensor)
    if sensors is not None and sensors.ndim == 2:
        measurements = measurements._replace(sensor=sensors.max(0))
    key = key[0] if checks.is_typed_key(key) and key.ndim else key
    runs = np.shape(inputs[1].value)[0]
    worst = _worst_prior(inputs[2], flags[2])
    for k in sorted({0, *lowest(params, params_f)}):
        own = one_run(params, params_f, k)
        start = prior if k else worst

        def filter_one(params: Params, start: Gaussian | None = start) -> None:
            validated(estimator, params, measurements, start, t0, times, clock, key)

        try:
            validated(estimator, own, measurements, start, t0, times, clock, key)
        except (TypeError, ValueError) as error:
            _name_forgotten(error, own, params_f, runs, filter_one)
            raise


def _name_forgotten(
    error: Exception,
    params: Params,
    flags: PyTree,
    runs: int,
    filter_one: Callable[[Params], None],
) -> None:
    """Raises in place of `error`, with the names of parameters that have a leading axis of runs and
    were not marked, if all is well with the first run of them."""
    pairs = zip(tree_leaves_with_path(params), jax.tree.leaves(flags), strict=True)
    names = [
        f"params{keystr(path)}"
        for (path, x), f in pairs
        if not f and np.shape(x)[:1] == (runs,) and runs > 1
    ]
    if not names:
        return
    # Tried with one run's share of what was not marked: only if that is accepted was the mark what
    # was missing, and the message may say so.
    first = jax.tree.map(lambda x, f: x if f or np.shape(x)[:1] != (runs,) else x[0], params, flags)
    try:
        filter_one(first)
    except (TypeError, ValueError):
        return
    raise ValueError(
        f"{names[0]}: expected a value that all runs share (a leading axis of runs is marked: "
        f"params_per_run=True, or a prefix of `params` of True and False), got a leading axis of "
        f"{runs}, as many as there are runs, in {', '.join(names)}"
    ) from error


def lowest(params: Params, flags: PyTree) -> set[int]:
    """The runs in which a number, or the eigenvalue of a matrix, that each run has of its own is
    lowest or not finite."""
    runs = set()
    for x, per_run in zip(*map(jax.tree.leaves, (params, flags)), strict=True):
        value = checks.concrete_value(x) if per_run and not checks.is_typed_key(x) else None
        if value is None or value.dtype.kind not in "iuf" or not value.size:
            continue
        runs.add(int(np.argmin(value.reshape(len(value), -1).min(1))))
        if value.dtype.kind == "f" and np.isposinf(value).any():
            runs.add(int(np.argmax(value.reshape(len(value), -1).max(1))))
        elif value.ndim >= 3 and value.shape[-1] == value.shape[-2] and np.isfinite(value).all():
            eigenvalues = _smallest_eigenvalues(value).reshape(len(value), -1).min(1)
            runs.add(int(np.argmin(eigenvalues)))
    return runs


def _smallest_eigenvalues(matrices: np.ndarray) -> np.ndarray:
    """The smallest eigenvalues of the symmetric parts."""
    return np.linalg.eigvalsh((matrices + np.swapaxes(matrices, -1, -2)) / 2)[..., 0]


def _check_prior_axes(prior: Gaussian | None, runs: int) -> None:
    if prior is None:
        return
    ok = isinstance(prior, Gaussian)
    require(ok, "prior", "a Gaussian(mean, cov) or None", type(prior).__name__)
    for argument, x, tail in (("mean", prior.mean, ("n",)), ("cov", prior.cov, ("n", "n"))):
        lead = ("R",) if np.ndim(x) > len(tail) else ()
        checks.shape(f"prior.{argument}", x, (*lead, *tail))
        each = not lead or np.shape(x)[0] == runs
        require(each, f"prior.{argument}", f"{runs} runs", f"shape {np.shape(x)}")
        checks.finite(f"prior.{argument}", x)
    n = np.shape(prior.mean)[-1]
    got = f"shape {np.shape(prior.cov)}"
    require(np.shape(prior.cov)[-2:] == (n, n), "prior.cov", f"matrices ({n}, {n})", got)


def _worst_prior(prior: Gaussian | None, flags: PyTree) -> Gaussian | None:
    """The prior of the run whose covariance is nearest to none (of the first, where all are
    positive definite)."""
    if prior is None:
        return None
    cov = checks.concrete_value(prior.cov) if flags.cov else None
    k = 0
    if cov is not None:
        # By the largest element of each run: what is asymmetric or indefinite by rounding depends
        # on units.
        scale = np.maximum(np.abs(cov).max((1, 2)), np.finfo(float).tiny)
        skew = np.abs(cov - np.swapaxes(cov, 1, 2)).max((1, 2)) / scale
        k = int(np.argmax(skew)) if skew.max() > 1e-5 else _least_definite(cov, scale)
    return one_run(prior, flags, k)


def _least_definite(cov: np.ndarray, scale: np.ndarray) -> int:
    scaled = cov.astype(float) / scale[:, None, None]
    try:
        factor = np.linalg.cholesky(scaled)  # several times as fast as the eigenvalues
    except np.linalg.LinAlgError:
        return int(np.argmin(_smallest_eigenvalues(scaled)))
    # What is left of a variance once the others are known: rounding alone where it is singular.
    left = np.diagonal(factor, axis1=1, axis2=2) ** 2 / np.diagonal(scaled, axis1=1, axis2=2)
    return int(np.argmin(left.min(1)))


def ranked(fields: PyTree, ranks: tuple[int, ...]) -> Any:
    """Which fields of a named tuple have more axes than one run needs."""
    return type(fields)(*(jnp.ndim(x) > rank for x, rank in zip(fields, ranks, strict=True)))
