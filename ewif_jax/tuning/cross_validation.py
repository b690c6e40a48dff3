"""Held-out losses: folds of runs and of time, tuned without and scored on each."""

from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import jax
import numpy as np
from jax import Array

from ewif_jax import checks
from ewif_jax.tuning.minimise import tune
from ewif_jax.tuning.tuned import Tuned
from ewif_jax.types import Measurement, Params, PyTree

Loss = Callable[..., Array]


class Fold(NamedTuple):
    """Rows (R, T) or (T,) bool to tune by, and rows held out."""

    train: np.ndarray
    held_out: np.ndarray


class CrossValidated(NamedTuple):
    """held_out (K,): the loss of each fold's rows with the parameters tuned without them; train
    (K,): that of the rows they were tuned by; mean () of the held-out losses and its standard error
    (); tuned: what `tune` found for each fold."""

    held_out: np.ndarray
    train: np.ndarray
    mean: float
    error: float
    tuned: tuple[Tuned, ...]


def run_folds(measurements: Measurement, folds: int) -> list[Fold]:
    """Folds of whole runs of a batch (R, T, ...): run k is held out in fold k mod `folds`.

    Raises:
        ValueError: a single stream; fewer runs than folds; fewer than two folds.
    """
    checks.whole("folds", folds, 2)
    shape = np.shape(measurements.value)
    batched = len(shape) == 3
    checks.require(batched, "measurements", "a batch (R, T, ...)", f"shape {shape}")
    enough = shape[0] >= folds
    checks.require(enough, "folds", f"at most {shape[0]}, the number of runs", folds)
    own = np.arange(shape[0]) % folds
    rows = np.ones(shape[:2], bool)
    return [Fold(rows & (own != k)[:, None], rows & (own == k)[:, None]) for k in range(folds)]


def time_folds(measurements: Measurement, folds: int, gap: float) -> list[Fold]:
    """Folds of blocks of validity time, equally long, with a gap.

    The filter runs through all rows in their order, so a held-out row is predicted from what came
    before it, as in use; only what is scored changes. A row after a held-out block is predicted
    from that block: rows within `gap` seconds of it, on either side, are not tuned by.

    Args:
        measurements: a stream (T, ...) or a batch (R, T, ...).
        folds: how many blocks.
        gap: seconds, >= 0: the filter's memory (some tau), and the largest delay.

    Raises:
        ValueError: fewer than two folds; a negative gap; a block without any row, or a gap that
            leaves none to tune by.
    """
    checks.whole("folds", folds, 2)
    checks.at_least("gap", gap, 0.0)
    present = np.asarray(measurements.mask, bool).any(-1)
    time = np.asarray(measurements.time, float)
    shape = np.broadcast_shapes(present.shape, time.shape, np.shape(measurements.value)[:-1])
    present, time = np.broadcast_to(present, shape), np.broadcast_to(time, shape)
    checks.require(bool(present.any()), "measurements", "some that are present", "none")
    ends = np.linspace(time[present].min(), time[present].max(), folds + 1)
    found = []
    for k, (low, high) in enumerate(pairwise(ends)):
        last = k == folds - 1
        inside = (time >= low) & ((time <= high) if last else (time < high))
        near = (time >= low - gap) & (time <= high + gap)
        fold = Fold(present & ~near, present & inside)
        held_out, train = fold.held_out.sum(), fold.train.sum()
        got = f"block {k} from {low:.6g} to {high:.6g} s has {held_out} rows, and {train} are left"
        got += " to tune by"
        ok = bool(fold.train.any() and fold.held_out.any())
        checks.require(ok, "folds", "rows in every block and outside of its gap", got)
        found.append(fold)
    return found


def cross_validated(
    loss_builder: Callable[[Any], Loss],
    folds: Sequence[Fold],
    params: Params,
    **options: Any,
) -> CrossValidated:
    r"""The loss on rows that the parameters were not tuned by.

    .. math::
        \frac1K \sum_k \text{loss}_{\text{fold } k} \Big( \arg\min_p \text{loss}_{\text{others}}(p)
            \Big)

    Args:
        loss_builder: where -> loss: the loss (params -> ()) of the rows `where` (booleans like
            those of the folds), such as
            ``lambda where: ej.likelihood_loss(kalman, data, prior=prior, t0=0.0, where=where)``.
        folds: from `run_folds` or `time_folds`, or pairs of booleans of your own.
        params: where each search starts.
        **options: as in `tune`.

    Returns:
        `CrossValidated`; its standard error treats folds as independent.

    Compiled once for all folds: which rows count is an argument of the program.

    Raises:
        ValueError: no fold; what `tune` refuses.
    """
    checks.require(len(folds) > 0, "folds", "at least one", "none")
    options = dict(options)
    fixed = options.pop("fixed", None)
    checks.require(
        fixed is None or isinstance(fixed, str | list | tuple), "fixed", "names", repr(fixed)
    )

    def of_both(both: dict[str, Any]) -> Array:
        return loss_builder(both["rows"] > 0)(both["params"])

    value = jax.jit(of_both)
    held_out, train, tuned = [], [], []
    for fold in folds:
        kept, left = (np.asarray(rows, float) for rows in Fold(*fold))
        both = {"params": params, "rows": kept}
        stays = {"params": _stays_fixed(fixed, params), "rows": True}
        given = {"params": _transform_tree(options.get("transforms"), params), "rows": None}
        search = tune(of_both, both, **{**options, "fixed": stays, "transforms": given})
        own = search.params["params"]
        names = search.transforms["params"]
        tuned.append(
            search._replace(params=own, history=_own_history(search.history), transforms=names)
        )
        held_out.append(float(value({"params": own, "rows": left})))
        train.append(float(value({"params": own, "rows": kept})))
    count = len(held_out)
    error = float(np.std(held_out, ddof=1) / np.sqrt(count)) if count > 1 else float("nan")
    return CrossValidated(
        np.asarray(held_out), np.asarray(train), float(np.mean(held_out)), error, tuple(tuned)
    )


def _stays_fixed(fixed: PyTree, params: Params) -> Any:
    if fixed is None:
        return False
    names = [fixed] if isinstance(fixed, str) else fixed
    return {name: name in names for name in params}


def _transform_tree(given: PyTree, params: Params) -> Any:
    """Of a mapping that names some parameters, None for the others."""
    both = isinstance(given, dict) and isinstance(params, dict)
    return {**dict.fromkeys(params), **given} if both else given


def _own_history(history: dict[str, Any]) -> dict[str, Any]:
    return {**history, "params": history["params"]["params"]}
